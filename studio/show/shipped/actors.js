// A run as it is seen: its parts, each as large and where a design or an episode has it, with the initial one as a ghost.

const LIT = { goal: 0x14c85a, button: 0xffd628, contact: 0xffb000 };
const GHOST = { thickness: 0.85, opacity: 0.3, colour: 0x8a94a0 };
const NOTHING = -32768; // stands for no contact
const MOST_STEPS = 32767; // steps from the middle to the farthest place in an episode
const LINK_HALF = 0.1; // m: half the length of a link as it is carried
const CAPSULE = new THREE.CapsuleGeometry(1, 2, 8, 20).rotateX(Math.PI / 2); // along z; its ends are at ±1

const SHAPES = {
  sphere: () => new THREE.SphereGeometry(1, 24, 16),
  box: () => new THREE.BoxGeometry(2, 2, 2),
  cylinder: () => new THREE.CylinderGeometry(1, 1, 2, 40).rotateX(Math.PI / 2),
  capsule: () => CAPSULE.clone(),
};

function geometryOf({ kind, mesh }, meshes) {
  if (mesh < 0) return SHAPES[kind]();
  return smooth(meshes[mesh].vertices, meshes[mesh].faces);
}

/** Give a shape its half-extents: a capsule keeps its ends round, a link its joints, all else is stretched. */
function fit(shape, kind, size, thickness = 1) {
  const [x, y, z] = size, radius = x * thickness;
  shape.visible = x > 0 || y > 0 || z > 0;
  if (kind === "mesh" || !shape.visible) return;
  if (kind === "capsule") stretch(shape, CAPSULE.attributes.position, radius, 1, z);
  else if (kind === "link") stretch(shape, shape.userData.whole, thickness, LINK_HALF, z);
  else shape.scale.set(radius, kind === "box" ? y : y * thickness, z * (kind === "sphere" ? thickness : 1));
}

/** Scale a shape from its own corners, and then move what is above and below its middle, `own` being half its length, so that it has another one. */
function stretch(shape, from, scale, own, half) {
  const { userData, geometry } = shape, to = geometry.attributes.position;
  if (userData.scale === scale && userData.half === half) return;
  Object.assign(userData, { scale, half });
  for (let i = 0; i < from.count; i++) {
    const along = from.getZ(i), end = Math.sign(along);
    to.setXYZ(i, from.getX(i) * scale, from.getY(i) * scale, end * half + (along - end * own) * scale);
  }
  to.needsUpdate = true;
  geometry.computeBoundingSphere();
}

class Actors {
  constructor(run, flat) {
    this.run = run;
    this.scene = new THREE.Scene();
    const reach = Math.hypot(...run.high.map((x, i) => x - run.low[i])) * 0.6;
    const middle = run.low.map((x, i) => (x + run.high[i]) / 2), lamps = lights(reach);
    for (const lamp of lamps) lamp.position.add({ x: middle[0], y: middle[1], z: middle[2] });
    lamps[1].target.position.set(...middle);
    this.scene.add(...lamps, lamps[1].target);
    this.shapes = run.cast.parts.map((part) => this.shape(part));
    this.ghosts = run.cast.parts.map((part) => (part.group === "robot" ? this.ghost(part) : null));
    this.dots = [];
    this.dotSize = reach * 0.014;
    this.decoded = new Map();
    this.scene.add(this.grid(flat));
    if (run.designs) this.standGhost();
  }

  update() {} // everything is where `stand` or `play` put it

  shape(part) {
    const [r, g, b] = part.colour, pale = part.group === "scenery" && part.name.startsWith("goal");
    const color = new THREE.Color().setRGB(r / 255, g / 255, b / 255, "srgb");
    const shape = this.mesh(part, { color, transparent: pale, opacity: pale ? 0.7 : 1 });
    shape.castShadow = part.group !== "scenery";
    shape.receiveShadow = !pale;
    return shape;
  }

  ghost(part) {
    const behind = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }; // where both are in one place
    return this.mesh(part, { color: GHOST.colour, transparent: true, opacity: GHOST.opacity, depthWrite: false, ...behind });
  }

  /** Return the mesh of a part, which is not seen before it is given its size. */
  mesh(part, look) {
    const shape = new THREE.Mesh(geometryOf(part, this.run.cast.meshes), paint(look));
    if (part.kind === "link") shape.userData.whole = shape.geometry.attributes.position.clone();
    shape.visible = false;
    this.scene.add(shape);
    return shape;
  }

  /** Return squares of a round size on the floor, and keep the size: they tell how large the bodies are. */
  grid(flat) {
    const { low, high } = this.run, longest = Math.max(high[0] - low[0], high[1] - low[1]);
    this.cell = ticks(0, longest, 9)[1] ?? longest;
    const [x0, y0, x1, y1] = [...low.slice(0, 2).map((x) => Math.floor(x / this.cell)), ...high.slice(0, 2).map((x) => Math.ceil(x / this.cell))];
    const z = flat ? low[2] : Math.max(low[2], 0) + 0.002 * this.cell, points = [];
    for (let x = x0; x <= x1; x++) points.push(x * this.cell, y0 * this.cell, z, x * this.cell, y1 * this.cell, z);
    for (let y = y0; y <= y1; y++) points.push(x0 * this.cell, y * this.cell, z, x1 * this.cell, y * this.cell, z);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points), 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: 0x808890, transparent: true, opacity: 0.35 }));
  }

  /** Return the ten numbers of a part in a design: half-extents, position and orientation. */
  numbers(part, design) {
    const { course } = this.run.designs, [, , designs] = course.shape;
    return Array.from({ length: 10 }, (_, k) => course[(10 * part + k) * designs + design]);
  }

  standGhost() {
    if (this.run.designs.reasons[0]) return;
    this.ghosts.forEach((shape, part) => {
      if (!shape) return;
      const row = this.numbers(part, 0);
      fit(shape, this.run.cast.parts[part].kind, row.slice(0, 3), GHOST.thickness);
      this.place(shape, row.slice(3, 6), row.slice(6));
      shape.userData.there = shape.visible;
    });
  }

  /** Show the initial design as a ghost, or not. */
  haunt(on) {
    for (const shape of this.ghosts) if (shape) shape.visible = on && Boolean(shape.userData.there);
  }

  place(shape, [x, y, z], [w, i, j, k]) {
    shape.position.set(x, y, z);
    shape.quaternion.set(i, j, k, w).normalize();
  }

  clear() {
    for (const shape of this.shapes) shape.visible = false;
    this.light(false, false);
    this.touch([]);
  }

  /** Show a design in its start posture, or a `share` of the way from it to another one; a reason shows nothing. */
  stand(design, next = design, share = 0) {
    const { reasons } = this.run.designs;
    this.light(false, false);
    this.touch([]);
    if (reasons[design]) return this.clear();
    const other = reasons[next] ? design : next;
    this.shapes.forEach((shape, part) => {
      let row = this.numbers(part, design);
      if (share && other !== design) {
        const to = this.numbers(part, other), sign = row.slice(6).reduce((sum, q, i) => sum + q * to[6 + i], 0) < 0 ? -1 : 1;
        row = row.map((value, k) => (1 - share) * value + share * to[k] * (k < 6 ? 1 : sign));
      }
      fit(shape, this.run.cast.parts[part].kind, row.slice(0, 3));
      this.place(shape, row.slice(3, 6), row.slice(6));
    });
  }

  /** Show an episode at a time in s. */
  play(episode, time) {
    const { parts, instants, reach, sizes } = episode, places = this.places(episode);
    const at = Math.min(time / this.run.control_dt, instants - 1), t = Math.floor(at), next = Math.min(t + 1, instants - 1), share = at - t;
    const design = this.designOf(episode);
    this.shapes.forEach((shape, part) => {
      if (this.run.cast.parts[part].group !== "scenery") shape.visible = false;
      else if (!this.run.designs.reasons[design]) {
        const row = this.numbers(part, design);
        fit(shape, this.run.cast.parts[part].kind, row.slice(0, 3));
        this.place(shape, row.slice(3, 6), row.slice(6));
      }
    });
    parts.forEach((part, i) => {
      const value = (k) => {
        const row = (7 * i + k) * instants;
        return ((1 - share) * places[row + t] + share * places[row + next]) / MOST_STEPS;
      };
      const shape = this.shapes[part];
      fit(shape, this.run.cast.parts[part].kind, sizes.slice(3 * i, 3 * i + 3));
      shape.visible = true;
      this.place(shape, [0, 1, 2].map((k) => reach * value(k)), [3, 4, 5, 6].map(value));
    });
    const step = t - 1; // what step t - 1 reached is seen from its end on
    this.light(step >= 0 && episode.success[step], step >= 0 && episode.pressed[step]);
    const [, contacts] = episode.contact.shape;
    const points = step < 0 ? [] : Array.from({ length: contacts }, (_, c) => [...episode.contact.slice(3 * (step * contacts + c), 3 * (step * contacts + c) + 3)]);
    this.touch(points.filter(([x]) => x !== NOTHING).map((point) => point.map((x) => (reach * x) / MOST_STEPS)));
  }

  designOf({ iteration }) {
    return Math.max(0, lastUpTo(this.run.course.design_iterations, iteration));
  }

  /** Return the places of an episode, which are told as steps from one instant to the next. */
  places(episode) {
    if (!this.decoded.has(episode)) {
      const places = new Int16Array(episode.steps);
      for (let i = 0; i < places.length; i++) if (i % episode.instants) places[i] += places[i - 1];
      this.decoded.set(episode, places);
    }
    return this.decoded.get(episode);
  }

  light(goal, button) {
    this.shapes.forEach((shape, i) => {
      const { name } = this.run.cast.parts[i];
      if (name.startsWith("goal")) shape.material.emissive.setHex(goal ? LIT.goal : 0);
      if (name === "button") shape.material.emissive.setHex(button ? LIT.button : 0);
    });
  }

  touch(points) {
    while (this.dots.length < points.length) {
      const dot = new THREE.Mesh(new THREE.SphereGeometry(this.dotSize, 12, 8), new THREE.MeshBasicMaterial({ color: LIT.contact, depthTest: false }));
      dot.renderOrder = 2;
      this.scene.add(dot);
      this.dots.push(dot);
    }
    this.dots.forEach((dot, i) => {
      dot.visible = i < points.length;
      if (dot.visible) dot.position.set(...points[i]);
    });
  }
}
