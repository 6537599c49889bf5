// Forces that a person applies: a spring from a point of a body to the pointer, and a short push against the object.

const PULL = { stiffness: 220, mass: 0.25, most: 25 }; // 1/s^2 for each kg that is pulled, kg at least, N at most
const PUSH = { weights: 1.5, seconds: 0.12 }; // how many times the object's weight, and for how long

class Forces {
  constructor(world) {
    this.world = world;
    this.release();
  }

  /** Hold a body at a point in the world (m). */
  hold(body, point) {
    const { data } = this.world, at = data.xpos.slice(3 * body, 3 * body + 3), r = data.xmat.slice(9 * body, 9 * body + 9);
    const d = point.map((x, i) => x - at[i]);
    this.held = { body, local: [0, 1, 2].map((j) => r[j] * d[0] + r[j + 3] * d[1] + r[j + 6] * d[2]), target: point };
    this.before = null;
  }

  release() {
    this.held = null;
    this.pushed = null;
  }

  push(direction) {
    this.pushed = { direction, left: PUSH.seconds };
    this.world.disturbed = true;
  }

  /** Return where in the world the held point is. */
  point() {
    const { body, local } = this.held, { xpos, xmat } = this.world.data;
    return [0, 1, 2].map((i) => xpos[3 * body + i] + [0, 1, 2].reduce((sum, j) => sum + xmat[9 * body + 3 * i + j] * local[j], 0));
  }

  /** Set the forces for the next step of the physics. */
  apply() {
    const { world } = this, { data } = world;
    data.xfrc_applied.fill(0);
    if (this.held) this.applyPull(world.dt);
    if (this.pushed) this.applyPush(world.dt);
  }

  applyPull(dt) {
    const { world, held } = this, { data, model } = world, point = this.point();
    const mass = Math.max(model.body_subtreemass[held.body], PULL.mass), { stiffness: k } = PULL;
    const speed = this.before ? point.map((x, i) => (x - this.before[i]) / dt) : [0, 0, 0];
    this.before = point;
    const force = held.target.map((x, i) => mass * (k * (x - point[i]) - 2 * Math.sqrt(k) * speed[i]));
    const size = Math.hypot(...force), share = Math.min(1, PULL.most / Math.max(size, 1e-9));
    this.add(held.body, force.map((f) => share * f), point.map((x, i) => x - data.xipos[3 * held.body + i]));
    world.disturbed = true;
  }

  applyPush(dt) {
    const { world, pushed } = this, mass = world.model.body_subtreemass[world.object];
    this.add(world.object, pushed.direction.map((x) => PUSH.weights * 9.81 * mass * x), [0, 0, 0]);
    pushed.left -= dt;
    if (pushed.left <= 0) this.pushed = null;
  }

  add(body, f, r) {
    const applied = this.world.data.xfrc_applied, k = 6 * body;
    const torque = [r[1] * f[2] - r[2] * f[1], r[2] * f[0] - r[0] * f[2], r[0] * f[1] - r[1] * f[0]];
    for (let i = 0; i < 3; i++) {
      applied[k + i] += f[i];
      applied[k + 3 + i] += torque[i];
    }
  }

  /** Return where an arrow for what acts now begins and ends, or null. */
  arrow() {
    if (this.held) return [this.point(), this.held.target];
    if (!this.pushed) return null;
    const { xipos } = this.world.data, at = [...xipos.slice(3 * this.world.object, 3 * this.world.object + 3)];
    return [at, at.map((x, i) => x + 0.15 * this.pushed.direction[i])];
  }
}

/** Let a pointer pull bodies; where it meets none, the camera turns. */
function letPull(stage, forcesOf, changed) {
  const { canvas, orbit } = stage, plane = new THREE.Plane();
  let forces = null;
  canvas.addEventListener("pointerdown", (event) => {
    const below = event.button === 0 && !forces && stage.below(event);
    if (!below) return;
    const [hit] = below.ray.intersectObjects(below.view.shapes.filter((shape) => shape.userData.body > 0), false);
    if (!hit) return;
    orbit.enabled = false;
    canvas.setPointerCapture(event.pointerId);
    forces = forcesOf(below.view);
    forces.hold(hit.object.userData.body, hit.point.toArray());
    plane.setFromNormalAndCoplanarPoint(stage.camera.getWorldDirection(new THREE.Vector3()), hit.point);
    changed();
  }, { capture: true });
  canvas.addEventListener("pointermove", (event) => {
    if (!forces) canvas.classList.toggle("over", Boolean(event.pointerType === "mouse" && isOverBody(stage, event)));
    const to = forces?.held && stage.below(event)?.ray.ray.intersectPlane(plane, new THREE.Vector3());
    if (to) forces.held.target = to.toArray();
  });
  const end = () => {
    forces?.release();
    forces = null;
    orbit.enabled = true;
    changed();
  };
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) canvas.addEventListener(kind, end);
}

function isOverBody(stage, event) {
  const below = event.buttons === 0 && stage.below(event);
  return below && below.ray.intersectObjects(below.view.shapes.filter((shape) => shape.userData.body > 0), false).length > 0;
}
