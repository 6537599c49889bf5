// What is seen: a view beside the other, one camera for all. A view has a scene, its shapes, and update().

const ASPECT = 1.2; // of a view that is to be neither wide nor high
const AIR = 1.12; // of what is framed, how much larger the picture is
const SLOW_FRAME = 24, FAST_FRAME = 18.5; // ms: with frames that are slower the picture becomes simpler, with faster ones better
const HELPED = 0.9; // of the time of a frame: with more of it a simpler picture has not helped
const PATIENCE = 12; // looks at fast frames after which a better picture is tried, and twice as many after each time
const FEWEST_FRAMES = 9, LONGEST_LOOK = 1500; // frames and ms after which it is judged whether they are slow
const FINEST = 4e6; // pixels of a picture in which nothing moves
const REST = 250; // ms without a change after which it is drawn
const QUALITIES = [[2, true], [1.25, true], [1, false], [0.7, false], [0.5, false]]; // most pixels for one of CSS; shadows
const CREASE = 0.6; // rad: an edge that is sharper stays an edge
const ALIKE = 0.02; // in each component of a normal

/** Frame a ball: seen along `sight`, with its centre in the middle. Lengths are in m. */
function aroundBall(sight, target, radius) {
  return { sight, target, distance: (half, aspect) => radius / Math.sin(half) / Math.min(1, aspect * 1.05) };
}

/** Frame a box between two corners, seen along `sight`: as near as its corners allow. */
function aroundBox(sight, low, high) {
  const way = new THREE.Vector3(...sight).normalize(), middle = low.map((x, i) => (x + high[i]) / 2);
  const right = new THREE.Vector3(0, 0, 1).cross(way).normalize(), up = way.clone().cross(right);
  const corners = Array.from({ length: 8 }, (_, i) => new THREE.Vector3(...low.map((x, k) => ((i >> k) & 1 ? high[k] : x) - middle[k])));
  const distance = (half, aspect) => Math.max(...corners.map((corner) => {
    const across = Math.abs(corner.dot(right)) / aspect, upward = Math.abs(corner.dot(up));
    return corner.dot(way) + (AIR * Math.max(across, upward)) / Math.tan(half);
  }));
  return { sight, target: middle, distance };
}

/** Return the lights of a scene that reaches so far, in m. */
function lights(reach) {
  const lamp = new THREE.DirectionalLight(0xffffff, 2.0);
  lamp.position.set(-reach, -1.3 * reach, 2.6 * reach);
  lamp.castShadow = true;
  lamp.shadow.mapSize.set(1024, 1024);
  Object.assign(lamp.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.7 * reach, far: 5 * reach });
  lamp.shadow.normalBias = 0.006 * reach;
  lamp.shadow.radius = 4;
  return [new THREE.HemisphereLight(0xffffff, 0xb8b2a8, 1.9), lamp];
}

const LIT_AT_CORNERS = {
  vertexShader: `
    #include <common>
    #include <colorspace_pars_fragment>
    #include <lights_pars_begin>
    uniform vec3 diffuse, emissive;
    varying vec3 lit;
    void main() {
      vec3 way = normalize(normalMatrix * normal), light = getHemisphereLightIrradiance(hemisphereLights[0], way);
      light += max(dot(way, directionalLights[0].direction), 0.0) * directionalLights[0].color;
      lit = sRGBTransferOETF(vec4(RECIPROCAL_PI * light * diffuse + emissive, 1.0)).rgb;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    }`,
  fragmentShader: `
    uniform float opacity;
    varying vec3 lit;
    void main() { gl_FragColor = vec4(lit, opacity); }`,
};

/** Return a material that looks like this; where no shadow falls it is lit at its corners alone, as a processor that draws has little time. */
function paint(look) {
  const material = new THREE.MeshLambertMaterial(look);
  material.onBeforeCompile = (shader, { shadowMap }) => { if (!shadowMap.enabled) Object.assign(shader, LIT_AT_CORNERS); };
  return material;
}

/** Return a mesh of triangles, smooth but for its edges; corners in one place that are lit alike are one. */
function smooth(positions, faces) {
  const flat = new THREE.BufferGeometry();
  flat.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions), 3));
  flat.setIndex(new THREE.BufferAttribute(new Uint32Array(faces), 1));
  const { position, normal } = THREE.toCreasedNormals(flat, CREASE).attributes; // a corner for each of each triangle
  const index = new Uint32Array(faces.length), known = Array.from({ length: positions.length / 3 }, () => []), kept = [];
  for (let i = 0; i < faces.length; i++) {
    const alike = (k) => [0, 1, 2].every((axis) => Math.abs(normal.getComponent(i, axis) - normal.getComponent(kept[k], axis)) < ALIKE);
    const there = known[faces[i]];
    let found = there.find(alike);
    if (found === undefined) there.push(found = kept.push(i) - 1);
    index[i] = found;
  }
  const geometry = new THREE.BufferGeometry();
  for (const [name, all] of Object.entries({ position, normal })) {
    const few = new Float32Array(3 * kept.length);
    kept.forEach((i, k) => few.set(all.array.subarray(3 * i, 3 * i + 3), 3 * k));
    geometry.setAttribute(name, new THREE.BufferAttribute(few, 3));
  }
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
  return geometry;
}

/** Return whether there is WebGL, and whether a processor has to draw. */
function graphics() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return { there: false };
  const about = gl.getExtension("WEBGL_debug_renderer_info");
  const name = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { there: true, slow: /swiftshader|llvmpipe|software|basic render/i.test(name) };
}

class Stage {
  /** `framing` tells from where everything is seen: which way, at what, and from how far. */
  constructor(canvas, { slow }, framing) {
    this.canvas = canvas;
    this.framing = framing;
    this.best = slow ? QUALITIES.findIndex(([, shadows]) => !shadows) : 0; // of moving pictures
    this.quality = this.best;
    this.simplest = QUALITIES.length - 1;
    Object.assign(this, { patience: PATIENCE, calm: 0, before: null });
    const wanted = { alpha: false, antialias: !slow, stencil: false, powerPreference: "high-performance" };
    this.renderer = new THREE.WebGLRenderer({ canvas, context: canvas.getContext("webgl2", wanted) }); // its own has alpha always
    this.renderer.shadowMap.enabled = QUALITIES[this.quality][1];
    this.camera = new THREE.PerspectiveCamera(32, 1);
    this.camera.up.set(0, 0, 1);
    this.orbit = new THREE.OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, { maxPolarAngle: 1.52, enablePan: false });
    this.views = [];
    this.frames = [];
    this.fine = false;
    this.orbit.addEventListener("change", () => this.touch());
    this.paint();
    this.home();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Show these worlds beside each other, or one above the other where the window is upright. */
  show(views) {
    this.views = views;
    this.resize();
    this.home();
  }

  home() {
    const { sight: way, target, distance } = this.framing, half = (this.camera.fov * Math.PI) / 360;
    const away = distance(half, this.rectangle(0).aspect), sight = new THREE.Vector3(...way).normalize().multiplyScalar(away);
    this.orbit.target.set(...target);
    Object.assign(this.orbit, { minDistance: 0.18 * away, maxDistance: 2.7 * away });
    Object.assign(this.camera, { near: 0.02 * away, far: 9 * away });
    this.camera.position.copy(sight.add(this.orbit.target));
    this.orbit.update();
  }

  /** Take the colour behind everything from the style: a canvas that is opaque is drawn faster. */
  paint() {
    this.renderer.setClearColor(getComputedStyle(this.canvas.parentElement).getPropertyValue("--stage").trim());
    this.touch();
  }

  /** Say that something has changed, so that the next picture is drawn. */
  touch() {
    this.touched = true;
  }

  /** Return how many views stand beside each other: so many that each is about as wide as it is high. */
  get columns() {
    const { clientWidth: width, clientHeight: height } = this.canvas, n = Math.max(this.views.length, 1);
    const unlike = (columns) => Math.abs(Math.log((width / columns / (height / Math.ceil(n / columns) || 1)) / ASPECT));
    return Array.from({ length: n }, (_, i) => i + 1).reduce((best, columns) => (unlike(columns) < unlike(best) ? columns : best));
  }

  /** Return where view `i` is on the canvas: left, top, width, height in pixels of CSS. */
  rectangle(i) {
    const { clientWidth, clientHeight } = this.canvas, { columns } = this;
    const width = clientWidth / columns, height = clientHeight / Math.ceil(Math.max(this.views.length, 1) / columns);
    return { left: (i % columns) * width, top: Math.floor(i / columns) * height, width, height, aspect: width / Math.max(height, 1) };
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement, [most, shadows] = QUALITIES[this.fine ? 0 : this.quality];
    const finest = Math.max(1, Math.min(most, Math.sqrt(FINEST / (clientWidth * clientHeight || 1))));
    this.renderer.setPixelRatio(this.fine ? finest : Math.min(devicePixelRatio, most));
    this.renderer.setSize(clientWidth, clientHeight, false);
    if (this.renderer.shadowMap.enabled !== shadows) {
      this.renderer.shadowMap.enabled = shadows;
      for (const view of this.views) for (const shape of view.shapes) shape.material.needsUpdate = true;
    }
    this.touch();
  }

  /** Draw what `moves` or has changed, and once more with all pixels when it has rested; return whether it was drawn. */
  present(ms, moves, prepare = () => {}) {
    if (moves || this.touched) this.changed = ms;
    else if (this.fine || ms - this.changed < REST) return false;
    const finely = !moves && !this.touched;
    prepare();
    this.draw({ finely });
    this.touched = false;
    return true;
  }

  /** Draw every view; `finely` where nothing moves, so that there is time for all pixels. */
  draw({ finely = false } = {}) {
    const { renderer, camera } = this, height = this.canvas.clientHeight;
    if (finely !== this.fine) {
      this.fine = finely;
      this.resize();
    }
    renderer.setScissorTest(this.views.length > 1);
    this.views.forEach((view, i) => {
      const { left, top, width, height: h, aspect } = this.rectangle(i);
      camera.aspect = aspect;
      camera.updateProjectionMatrix();
      renderer.setViewport(left, height - top - h, width, h);
      renderer.setScissor(left, height - top - h, width, h);
      view.update();
      renderer.render(view.scene, camera);
    });
  }

  /** Make the picture simpler if frames take too long and that helps, and better after many fast ones: `ms` since the one before. */
  pace(ms) {
    this.frames.push(ms);
    const { length } = this.frames, passed = this.frames.reduce((sum, one) => sum + one, 0);
    if (length < FEWEST_FRAMES || (length < 45 && passed < LONGEST_LOOK)) return;
    const middle = this.frames.sort((a, b) => a - b)[length >> 1];
    this.frames = [];
    const { before } = this;
    this.before = null;
    if (before && middle > HELPED * before) {
      this.simplest = this.quality - 1;
      this.change(this.simplest);
    } else if (middle > SLOW_FRAME && this.quality < this.simplest) {
      this.before = middle;
      this.change(this.quality + 1);
    } else if (middle < FAST_FRAME && this.quality > this.best && ++this.calm >= this.patience) {
      this.patience *= 2;
      this.change(this.quality - 1);
    }
  }

  change(quality) {
    this.quality = quality;
    this.calm = 0;
    this.resize();
  }

  /** Return the view below a pointer, and the ray from the camera through it. */
  below(event) {
    const box = this.canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const i = this.views.findIndex((_, k) => {
      const { left, top, width, height } = this.rectangle(k);
      return x >= left && x < left + width && y >= top && y < top + height;
    });
    if (i < 0) return null;
    const { left, top, width, height, aspect } = this.rectangle(i), ray = new THREE.Raycaster();
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
    ray.setFromCamera(new THREE.Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height), this.camera);
    return { view: this.views[i], ray };
  }
}
