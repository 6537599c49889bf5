// A hand on its table in MuJoCo: a try begins, the policy acts as in the exported program, the task's rule judges.

const FASTEST = 100; // m/s or rad/s: beyond it a simulation has exploded, as in training
const SENSED = 4; // numbers of a contact sensor: how many contacts, and where the strongest is
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

/** Return a start as the task draws one: where the object lies (m), and how far it is turned (rad). */
function randomStart(rule) {
  const noise = () => (2 * Math.random() - 1) * rule.start_noise;
  return { position: [noise(), noise()], turn: 5 * noise() };
}

class World {
  constructor(mujoco, rule, design) {
    Object.assign(this, { mujoco, rule });
    this.exchange(design);
  }

  /** Simulate this design from now on; the one before stays where MuJoCo can't build it. */
  exchange(design) {
    const files = new this.mujoco.MjVFS();
    for (const [path, content] of Object.entries(design.files)) files.addBuffer(path, bytes(content));
    let model;
    try {
      model = this.mujoco.MjModel.from_xml_string(design.xml, files);
    } finally {
      files.delete();
    }
    this.free();
    Object.assign(this, { design, model, policy: design.layers && new Policy(design.layers) });
    this.data = new this.mujoco.MjData(model);
    this.dt = model.opt.timestep; // s
    this.object = this.body("object");
    this.button = this.body("button");
    this.reset({ position: [0, 0], turn: 0 });
  }

  free() {
    this.data?.delete();
    this.model?.delete();
  }

  body(name) {
    return this.mujoco.mj_name2id(this.model, this.mujoco.mjtObj.mjOBJ_BODY.value, name);
  }

  /** Begin a try. */
  reset({ position, turn }) {
    const { model, data, rule } = this, k = rule.joints;
    this.mujoco.mj_resetDataKeyframe(model, data, 0);
    const start = [...position, rule.half_extents[2], Math.cos(turn / 2), 0, 0, Math.sin(turn / 2), 0];
    data.qpos.set(start, k);
    this.steps = 0; // of the physics
    this.reached = []; // whether the goal was reached, at each control step
    this.disturbed = false; // whether somebody pulled or pushed
    this.diverged = false;
    this.mujoco.mj_forward(model, data);
    data.qacc_warmstart.fill(0); // as the task begins
    this.judge();
  }

  get controlSteps() {
    return this.reached.length;
  }

  get over() {
    return this.controlSteps >= this.rule.horizon;
  }

  get time() {
    return this.steps * this.dt;
  }

  /** Whether the goal was reached in at least half of the last ten control steps. */
  get solved() {
    const last = this.reached.slice(-10);
    return !this.diverged && last.filter(Boolean).length >= 0.5 * last.length && last.length > 0;
  }

  /** Advance by one step of the physics; the policy acts, and the rule judges, between two control steps. */
  step() {
    if (this.diverged) return;
    if (this.steps % this.design.substeps === 0) this.act();
    this.mujoco.mj_step(this.model, this.data);
    this.steps++;
    if (this.steps % this.design.substeps === 0) {
      if (!this.data.qvel.every((v) => Math.abs(v) < FASTEST)) this.diverged = true;
      this.judge();
      this.reached.push(this.now.goal && !this.diverged);
    }
  }

  /** Set the servos' targets as the exported program does: run_policy.py. */
  act() {
    const { middle, spread, action_scale: scale } = this.design, { qpos, ctrl } = this.data;
    if (!this.policy) return;
    const n = middle.length, sign = qpos[n - 4] < 0 ? -1 : 1; // q and -q are the same orientation
    const seen = new Float32Array(n);
    for (let i = 0; i < n; i++) seen[i] = ((i < n - 4 ? 1 : sign) * qpos[i] - middle[i]) / spread[i];
    const range = this.model.actuator_ctrlrange;
    this.policy.mean(seen).forEach((a, i) => {
      ctrl[i] = clamp(qpos[i] + scale[i] * clamp(a, -1, 1), range[2 * i], range[2 * i + 1]);
    });
  }

  /** Find out what is so now: which fingers touch what, and whether the goal is reached, as the task's `step` does. */
  judge() {
    const { rule, data } = this, k = rule.joints, { qpos, sensordata } = data;
    const onButton = [], onBody = [], contacts = [];
    for (let finger = 0; finger < rule.fingers; finger++) {
      for (const [target, list] of [onButton, onBody].entries()) {
        const at = SENSED * (2 * finger + target), found = sensordata[at] > 0;
        list.push(found);
        if (found) contacts.push({ finger, onButton: target === 0, point: [...sensordata.slice(at + 1, at + 4)] });
      }
    }
    const [w, x, y, z] = qpos.slice(k + 3, k + 7), [a, b, c] = rule.half_extents;
    const up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)].map(Math.abs);
    const risen = qpos[k + 2] - (up[0] * a + up[1] * b + up[2] * c);
    const count = (list) => list.filter(Boolean).length;
    const pressed = onButton.some(Boolean) && qpos[k + 7] < rule.pressed_at;
    const lifted = risen > rule.lift_height && count(onButton.map((on, i) => on || onBody[i])) >= 2;
    const besides = onButton.some((on, i) => on && count(onBody) - onBody[i] >= 2);
    const goal = pressed && lifted && (besides || !rule.besides_presser);
    this.now = { contacts, pressed, lifted, goal, risen };
  }
}

/** Run a whole try without a picture; return qpos after each control step, and whether it succeeded. */
function runTry(world, start, steps = world.rule.horizon) {
  const states = [];
  world.reset(start);
  while (states.length < steps) {
    for (let i = 0; i < world.design.substeps; i++) world.step();
    states.push([...world.data.qpos]);
  }
  return { states, solved: world.solved, reached: world.reached };
}
