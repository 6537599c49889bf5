// Forces that a person applies: a spring from a point of a body to the pointer, and a short push against the object.

const PULL = { stiffness: 1200, most: 25 }; // 1/s^2 for each kg that the held point weighs, and N; stiffer springs shake at 100 steps a second
const LINK = 0.25; // kg that a point of a finger weighs at least: its drive's armature, at the end of a link
const PUSH = { weights: 1.5, seconds: 0.12 }; // how many times the object's weight, and for how long

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

class Forces {
  constructor(world) {
    this.world = world;
    this.release();
  }

  /** Hold a body at a point in the world (m). */
  hold(body, point) {
    if (body === this.world.button) body = this.world.object; // it is so light that a spring would shake it
    const { data } = this.world, at = data.xpos.slice(3 * body, 3 * body + 3), r = data.xmat.slice(9 * body, 9 * body + 9);
    const d = point.map((x, i) => x - at[i]);
    this.held = { body, local: [0, 1, 2].map((j) => r[j] * d[0] + r[j + 3] * d[1] + r[j + 6] * d[2]), target: point };
    this.held.mass = body === this.world.object ? this.weight(body, point) : LINK;
    this.before = null;
  }

  /** Return what a free body weighs (kg) at a point, in the direction in which that is least. */
  weight(body, point) {
    const { data, model } = this.world, mass = model.body_subtreemass[body], inertia = model.body_inertia.slice(3 * body, 3 * body + 3);
    const m = data.ximat.slice(9 * body, 9 * body + 9), r = point.map((x, i) => x - data.xipos[3 * body + i]);
    const answer = (force) => { // of the point, an acceleration
      const torque = cross(r, force), own = [0, 1, 2].map((j) => (m[j] * torque[0] + m[j + 3] * torque[1] + m[j + 6] * torque[2]) / inertia[j]);
      const turn = cross([0, 1, 2].map((i) => m[3 * i] * own[0] + m[3 * i + 1] * own[1] + m[3 * i + 2] * own[2]), r);
      return force.map((f, i) => f / mass + turn[i]);
    };
    let way = [0.6, 0.5, 0.62], size = 1;
    for (let i = 0; i < 20; i++) {
      const next = answer(way);
      size = Math.hypot(...next);
      way = next.map((x) => x / size);
    }
    return 1 / size;
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
    const { world, held } = this, { data } = world, point = this.point(), { stiffness: k } = PULL;
    const speed = this.before ? point.map((x, i) => (x - this.before[i]) / dt) : [0, 0, 0];
    this.before = point;
    const force = held.target.map((x, i) => held.mass * (k * (x - point[i]) - 2 * Math.sqrt(k) * speed[i]));
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
    const torque = cross(r, f);
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
