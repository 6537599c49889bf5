// The page: it unpacks what it carries, runs the worlds on one clock, and counts their tries.

const AFTER = 0.8; // s of simulated time between the end of a try and the next one
const SPEEDS = [1, 0.5, 0.25, 0.1];
const MOST_BEHIND = 0.25; // s: a page that was hidden does not catch up
const REPORT_EVERY = 0.2; // s between two changes of what is written

const missing = { webgl: "This browser has no WebGL, so that nothing moves here.", wasm: "This browser has no WebAssembly, so that MuJoCo can't run here." };

const STAYS = "The picture and the numbers are all the same those of this design.";

/** Say why nothing runs; the picture and the numbers stay. */
function giveUp(sentence, stays = STAYS) {
  document.body.dataset.state = "still";
  say(`${sentence} ${stays}`.trim());
}

class Tally {
  constructor() {
    this.tries = { undisturbed: [0, 0], disturbed: [0, 0] };
  }

  count(world) {
    const entry = this.tries[world.disturbed ? "disturbed" : "undisturbed"];
    entry[0] += world.solved;
    entry[1]++;
  }

  get text() {
    const [good, all] = this.tries.undisturbed, [goodToo, more] = this.tries.disturbed;
    const share = all ? `${good} of ${all} tries (${Math.round((100 * good) / all)} %)` : "no try finished yet";
    return more ? `${share} · ${goodToo} of ${more} with your help` : share;
  }
}

class Show {
  constructor(mujoco, hands, graphics) {
    Object.assign(this, { mujoco, rule: hands.rule, designs: hands.designs, shaping: hands.shaping, speed: 1, behind: 0 });
    this.running = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.stage = new Stage($("stage"), graphics, FRAMING);
    this.shown = [this.seat(this.designs[0], 0)];
    this.arrange();
    this.tryAnew();
    letPull(this.stage, (view) => this.shown.find((seat) => seat.view === view).forces, () => this.write());
  }

  /** Return a design with its simulation, its view, its forces, and what is written of it. */
  seat(design, index) {
    const world = new World(this.mujoco, this.rule, design);
    return { design, world, view: new View(world), forces: new Forces(world), tally: new Tally(), label: $(`label-${index}`) };
  }

  arrange() {
    this.stage.show(this.shown.map((seat) => seat.view));
    for (const index of [0, 1]) $(`label-${index}`).hidden = index >= this.shown.length;
    document.body.dataset.views = this.shown.length;
    this.place();
  }

  place() {
    this.shown.forEach(({ label }, i) => {
      const { left, top, width } = this.stage.rectangle(i);
      Object.assign(label.style, { left: `${left}px`, top: `${top}px`, maxWidth: `${width}px` });
    });
  }

  compare(on) {
    if (on === this.shown.length > 1 || this.designs.length < 2) return;
    if (on) this.second ??= this.seat(this.designs[1], 1);
    this.shown = on ? [this.shown[0], this.second] : [this.shown[0]];
    this.arrange();
    this.tryAnew();
  }

  /** Give the first world the hand of phi; return why it can't be built, or "". */
  shape(phi) {
    const why = whyNot(this.shaping, phi);
    if (!why) this.exchange(shaped(this.designs[0], this.shaping, phi));
    return why;
  }

  /** Let the first world go on with another design; its tries are counted from none. */
  exchange(design) {
    const [seat] = this.shown;
    seat.forces.release();
    seat.world.exchange(design);
    seat.view.build();
    Object.assign(seat, { design, tally: new Tally() });
    this.tryAnew();
  }

  /** Begin a try with a start of its own, the same for all that is shown. */
  tryAnew(start = randomStart(this.rule)) {
    for (const { world, forces } of this.shown) {
      if (!this.held) forces.release();
      world.reset(start);
    }
    this.counted = false;
    this.after = 0;
    this.write();
  }

  push() {
    const away = this.stage.camera.getWorldDirection(new THREE.Vector3());
    const angle = Math.atan2(away.y, away.x) + (Math.random() - 0.5) * 2;
    for (const { forces } of this.shown) forces.push([Math.cos(angle), Math.sin(angle), 0]);
    if (!this.running) this.run(true);
  }

  run(on) {
    this.running = on;
    this.write();
  }

  /** Advance all worlds by one step of the physics. */
  step() {
    for (const { world, forces } of this.shown) {
      forces.apply();
      world.step();
    }
    const { world } = this.shown[0];
    if (!this.shown.every((seat) => seat.world.over || seat.world.diverged)) return;
    if (!this.counted) {
      for (const seat of this.shown) if (seat.world.policy) seat.tally.count(seat.world);
      this.counted = true;
      this.verdicts = this.shown.map((seat) => seat.world.solved);
      this.write();
    }
    this.after += world.dt;
    if ($("auto").checked && this.after > AFTER && !this.shown.some(({ forces }) => forces.held)) this.tryAnew();
  }

  frame(ms) {
    const passed = this.last === undefined ? 0 : (ms - this.last) / 1000;
    this.last = ms;
    if (this.running) {
      this.behind = Math.min(this.behind + passed * this.speed, MOST_BEHIND);
      const { dt } = this.shown[0].world, before = performance.now();
      for (; this.behind >= dt; this.behind -= dt, this.simulated += dt) this.step();
      this.physicsMs += performance.now() - before;
    }
    this.stage.orbit.update();
    const arrows = this.shown.map(({ forces }) => forces.arrow());
    const drawn = this.stage.present(ms, this.running || arrows.some(Boolean), () => {
      this.shown.forEach(({ view }, i) => view.point(...(arrows[i] ?? [null, null])));
    });
    if (drawn && this.running) this.stage.pace(1000 * passed);
    this.frames += drawn;
    if (this.running && ms - (this.written ?? 0) > 1000 * REPORT_EVERY) {
      this.written = ms;
      this.write();
    }
  }

  frames = 0;
  simulated = 0; // s
  physicsMs = 0;

  write() {
    put($("run"), this.running ? "❚❚ Pause" : "▶ Start");
    $("run").setAttribute("aria-pressed", String(this.running));
    this.shown.forEach(({ design, world, tally, label }, i) => {
      const { now } = world, verdict = this.counted && world.policy ? (this.verdicts[i] ? "success" : "failed") : "";
      put(label.querySelector(".who"), design.label);
      label.querySelector(".lifted").dataset.on = now.lifted;
      label.querySelector(".pressed").dataset.on = now.pressed;
      label.querySelector(".goal").dataset.on = now.goal;
      put(label.querySelector(".tally"), world.policy ? tally.text : "no policy");
      put(label.querySelector(".risen"), `${(100 * Math.max(0, now.risen)).toFixed(0)} cm up`);
      label.dataset.verdict = verdict;
      put(label.querySelector(".verdict"), { success: "✓ held", failed: "✗ not held", "": "" }[verdict]);
    });
    const { horizon, control_dt: dt } = this.rule, time = Math.min(this.shown[0].world.time, horizon * dt);
    $("clock").value = time / (horizon * dt);
    put($("time"), `${time.toFixed(1)} of ${(horizon * dt).toFixed(0)} s`);
    this.stage.touch();
  }
}

function connect(show) {
  const press = {
    run: () => show.run(!show.running),
    again: () => show.tryAnew(),
    push: () => show.push(),
    home: () => show.stage.home(),
  };
  for (const [id, act] of Object.entries(press)) $(id).addEventListener("click", act);
  $("speed").addEventListener("change", () => { show.speed = Number($("speed").value); });
  $("compare").addEventListener("change", () => show.compare($("compare").checked));
  $("compare").closest("label").hidden = show.designs.length < 2;
  const slower = () => {
    $("speed").value = String(SPEEDS[(SPEEDS.indexOf(show.speed) + 1) % SPEEDS.length]);
    show.speed = Number($("speed").value);
  };
  const turn = (x, y) => {
    const { camera, orbit } = show.stage, from = camera.position.clone().sub(orbit.target), flat = Math.hypot(from.x, from.y);
    const angle = Math.atan2(from.y, from.x) + x, above = clamp(Math.atan2(from.z, flat) + y, 0.06, 1.5), r = from.length();
    camera.position.set(r * Math.cos(above) * Math.cos(angle), r * Math.cos(above) * Math.sin(angle), r * Math.sin(above)).add(orbit.target);
  };
  const keys = {
    " ": press.run, r: press.again, p: press.push, h: press.home, s: slower,
    c: () => show.designs.length > 1 && $("compare").click(),
    t: () => $("theme").click(),
    ArrowLeft: () => turn(-0.12, 0), ArrowRight: () => turn(0.12, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
  };
  document.addEventListener("keydown", (event) => {
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key], { target } = event;
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    if (target.closest?.('input[type="range"], select, summary') || (target.closest?.("input") && event.key === " ") || (target.closest?.("button") && event.key === " ")) return;
    event.preventDefault();
    act();
  });
  $("theme").addEventListener("click", () => show.stage.paint()); // after the page has changed
  new ResizeObserver(() => show.place()).observe($("stage"));
}

/** Put a slider beside each entry of phi; what is dragged is built as often as there is time. */
function connectSliders(show) {
  const { shaping } = show, rows = [...document.querySelectorAll("#phi tbody tr")];
  if (!shaping) return;
  const sliders = shaping.parameters.map(({ name, unit, lo, hi, value }, i) => {
    const slider = Object.assign(document.createElement("input"), { type: "range", min: lo, max: hi, step: "any", value });
    slider.setAttribute("aria-label", `${name} in ${unit}`);
    rows[i].lastElementChild.append(slider);
    return slider;
  });
  const untrained = shaping.bias_slope ? "The policy is told this φ." : "The policy was not trained for this body.";
  let waiting = false;
  const build = () => {
    waiting = false;
    const phi = sliders.map((slider) => slider.valueAsNumber);
    $("phi-note").textContent = show.shape(phi) || untrained;
  };
  const write = () => sliders.forEach((slider, i) => {
    const value = slider.valueAsNumber, change = value - shaping.parameters[i].initial, cells = rows[i].cells;
    cells[1].textContent = value.toFixed(3);
    cells[3].textContent = `${change < 0 ? "−" : "+"}${Math.abs(change).toFixed(3)}`;
  });
  for (const slider of sliders) {
    slider.addEventListener("input", () => {
      write();
      $("unshape").hidden = false;
      if (!waiting) setTimeout(build, 60);
      waiting = true;
    });
  }
  $("unshape").addEventListener("click", () => {
    sliders.forEach((slider, i) => { slider.value = shaping.parameters[i].value; });
    write();
    show.exchange(show.designs[0]);
    $("phi-note").textContent = "";
    $("unshape").hidden = true;
  });
}

async function begin() {
  connectPage();
  $("loading").hidden = false;
  const packed = unpackedText("hands"), wasm = unpacked("wasm"), drawn = graphics();
  const hands = JSON.parse(await packed);
  if (!hands.designs.length) return giveUp(hands.missing, "");
  if (typeof WebAssembly !== "object") return giveUp(missing.wasm);
  if (!drawn.there) return giveUp(missing.webgl);
  say(hands.missing);
  const mujoco = await MUJOCO.default({ wasmBinary: await wasm });
  const show = new Show(mujoco, hands, drawn);
  connect(show);
  connectSliders(show);
  document.body.dataset.state = "live";
  watchGraphics(show.stage, STAYS, hands.missing);
  show.place();
  show.stage.resize();
  show.stage.home();
  await new Promise((resolve) => {
    const frame = (ms) => {
      show.frame(ms);
      show.firstFrame ??= performance.now();
      resolve();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  });
  return show;
}

// What tests ask: the page when its first picture is drawn, and whole tries without pictures from given starts.
globalThis.show = {
  ready: begin().catch((error) => giveUp(`MuJoCo could not begin here: ${error.message ?? error}.`)),
  async tries(starts, design = 0) {
    const { mujoco, rule, designs } = await this.ready, world = new World(mujoco, rule, designs[design]);
    const results = starts.map((start) => runTry(world, start));
    world.free();
    return results;
  },
  async shaped(phi) {
    const { designs, shaping } = await this.ready;
    return shaped(designs[0], shaping, phi);
  },
};
