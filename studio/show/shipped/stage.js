// What is seen: MuJoCo's geoms as three.js draws them, a view beside the other for each world, one camera for all.

const GEOM = { plane: 0, sphere: 2, capsule: 3, cylinder: 5, box: 6, mesh: 7 }; // mjtGeom
const COLLISION_GROUP = 3; // shapes that stand behind the printed parts
const SIGHT = [0.55, -1.25, 0.62], LOOK_AT = [0, 0, 0.26], RADIUS = 0.62; // m: what is framed
const SLOW_FRAME = 24; // ms: with frames that are slower on average the picture becomes simpler
const QUALITIES = [[2, true], [1.25, true], [1, false], [0.7, false], [0.5, false]]; // most pixels for one of CSS; shadows
const LIT = { button: 0xff5a1f, contact: 0xffb000 };

function geometryOf(model, geom) {
  const type = model.geom_type[geom], [a, b, c] = model.geom_size.slice(3 * geom, 3 * geom + 3);
  const upright = (shape) => shape.rotateX(Math.PI / 2); // three.js has them along y, MuJoCo along z
  switch (type) {
    case GEOM.plane: return new THREE.BoxGeometry(2 * a, 2 * b, 0.02).translate(0, 0, -0.01);
    case GEOM.sphere: return new THREE.SphereGeometry(a, 24, 16);
    case GEOM.capsule: return upright(new THREE.CapsuleGeometry(a, 2 * b, 8, 20));
    case GEOM.cylinder: return upright(new THREE.CylinderGeometry(a, a, 2 * b, 40));
    case GEOM.box: return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
    case GEOM.mesh: return meshOf(model, model.geom_dataid[geom]);
    default: return new THREE.SphereGeometry(1, 24, 16).scale(a, b, c);
  }
}

function meshOf(model, mesh) {
  const geometry = new THREE.BufferGeometry();
  const corners = model.mesh_vertadr[mesh] * 3, faces = model.mesh_faceadr[mesh] * 3;
  const vertices = model.mesh_vert.slice(corners, corners + 3 * model.mesh_vertnum[mesh]);
  const index = model.mesh_face.slice(faces, faces + 3 * model.mesh_facenum[mesh]);
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(vertices), 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(index), 1));
  return THREE.toCreasedNormals(geometry, 0.6);
}

/** One world as it is drawn. */
class View {
  constructor(world) {
    this.scene = new THREE.Scene();
    this.world = world;
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb8b2a8, 1.9), this.lamp());
    this.dots = Array.from({ length: 2 * world.rule.fingers }, () => this.dot());
    this.arrow = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 0.1, LIT.button, 0.03, 0.02);
    this.arrow.visible = false;
    this.scene.add(this.arrow);
    this.robot = new THREE.Group();
    this.scene.add(this.robot);
    this.build();
  }

  lamp() {
    const lamp = new THREE.DirectionalLight(0xffffff, 2.0);
    lamp.position.set(-0.7, -0.9, 1.8);
    lamp.castShadow = true;
    lamp.shadow.mapSize.set(1024, 1024);
    Object.assign(lamp.shadow.camera, { left: -0.7, right: 0.7, top: 0.7, bottom: -0.7, near: 0.5, far: 3.5 });
    lamp.shadow.normalBias = 0.004;
    lamp.shadow.radius = 4;
    return lamp;
  }

  dot() {
    const shape = (radius, opacity) => new THREE.Mesh(
      new THREE.SphereGeometry(radius, 16, 12),
      new THREE.MeshBasicMaterial({ color: LIT.contact, transparent: true, opacity, depthTest: false }),
    );
    const dot = shape(0.008, 1);
    dot.add(shape(0.02, 0.28));
    dot.visible = false;
    dot.renderOrder = 2;
    this.scene.add(dot);
    return dot;
  }

  /** Make the shapes anew, of the world's model as it is now. */
  build() {
    const { model, button } = this.world, shared = new Map();
    this.robot.traverse((node) => node.geometry?.dispose());
    this.robot.clear();
    this.shapes = [];
    for (let geom = 0; geom < model.ngeom; geom++) {
      if (model.geom_group[geom] === COLLISION_GROUP) continue;
      const mesh = model.geom_type[geom] === GEOM.mesh ? model.geom_dataid[geom] : `geom ${geom}`;
      if (!shared.has(mesh)) shared.set(mesh, geometryOf(model, geom));
      const [r, g, b, opacity] = model.geom_rgba.slice(4 * geom, 4 * geom + 4), body = model.geom_bodyid[geom];
      const scenery = body === 0, ghost = scenery && model.geom_type[geom] !== GEOM.plane;
      const material = new THREE.MeshLambertMaterial({
        color: new THREE.Color().setRGB(r, g, b, "srgb"), transparent: ghost || opacity < 1, opacity: ghost ? 0.55 : opacity,
      });
      const shape = new THREE.Mesh(shared.get(mesh), material);
      shape.matrixAutoUpdate = false;
      shape.castShadow = !scenery;
      shape.receiveShadow = !ghost;
      shape.userData = { geom, body, isButton: body === button };
      this.robot.add(shape);
      this.shapes.push(shape);
    }
  }

  /** Put everything where the simulation has it. */
  update() {
    const { data, now } = this.world, { geom_xpos: p, geom_xmat: m } = data;
    for (const shape of this.shapes) {
      const i = 3 * shape.userData.geom, k = 9 * shape.userData.geom;
      shape.matrix.set(
        m[k], m[k + 1], m[k + 2], p[i], m[k + 3], m[k + 4], m[k + 5], p[i + 1], m[k + 6], m[k + 7], m[k + 8], p[i + 2],
        0, 0, 0, 1,
      );
      shape.matrixWorldNeedsUpdate = true;
      if (shape.userData.isButton) shape.material.emissive.setHex(now.pressed ? LIT.button : 0x000000);
    }
    this.dots.forEach((dot, i) => {
      const contact = now.contacts[i];
      dot.visible = Boolean(contact);
      if (contact) dot.position.set(...contact.point);
    });
  }

  /** Draw the force that somebody applies: from where it acts towards `to`, or nothing. */
  point(from, to) {
    this.arrow.visible = Boolean(from);
    if (!from) return;
    const way = new THREE.Vector3(...to).sub(new THREE.Vector3(...from)), length = Math.max(way.length(), 0.02);
    this.arrow.position.set(...from);
    this.arrow.setDirection(way.normalize());
    this.arrow.setLength(length, Math.min(0.03, length / 2), 0.018);
  }
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
  constructor(canvas, { slow }) {
    this.canvas = canvas;
    this.quality = slow ? QUALITIES.length - 2 : 0;
    this.renderer = new THREE.WebGLRenderer({ canvas, alpha: false, antialias: !slow, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = QUALITIES[this.quality][1];
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.05, 20);
    this.camera.up.set(0, 0, 1);
    this.orbit = new THREE.OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, { minDistance: 0.4, maxDistance: 6, maxPolarAngle: 1.52, enablePan: false });
    this.views = [];
    this.frames = [];
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
    const { aspect } = this.rectangle(0), half = (this.camera.fov * Math.PI) / 360;
    const distance = RADIUS / Math.sin(half) / Math.min(1, aspect * 1.05);
    const sight = new THREE.Vector3(...SIGHT).normalize().multiplyScalar(distance);
    this.orbit.target.set(...LOOK_AT);
    this.camera.position.copy(sight.add(this.orbit.target));
    this.orbit.update();
  }

  /** Take the colour behind everything from the style: a canvas that is opaque is drawn faster. */
  paint() {
    this.renderer.setClearColor(getComputedStyle(this.canvas.parentElement).backgroundColor);
  }

  get stacked() {
    return this.canvas.clientWidth < 1.2 * this.canvas.clientHeight;
  }

  /** Return where view `i` is on the canvas: left, top, width, height in pixels of CSS. */
  rectangle(i) {
    const { clientWidth: width, clientHeight: height } = this.canvas, n = Math.max(this.views.length, 1);
    const w = this.stacked ? width : width / n, h = this.stacked ? height / n : height;
    return { left: this.stacked ? 0 : i * w, top: this.stacked ? i * h : 0, width: w, height: h, aspect: w / Math.max(h, 1) };
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas.parentElement, [most, shadows] = QUALITIES[this.quality];
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, most));
    this.renderer.setSize(clientWidth, clientHeight, false);
    if (this.renderer.shadowMap.enabled !== shadows) {
      this.renderer.shadowMap.enabled = shadows;
      for (const view of this.views) for (const shape of view.shapes) shape.material.needsUpdate = true;
    }
  }

  draw() {
    const { renderer, camera } = this, height = this.canvas.clientHeight;
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

  /** Make the picture simpler if frames take too long: `ms` since the one before. */
  pace(ms) {
    this.frames.push(ms);
    if (this.frames.length < 45) return;
    const middle = this.frames.sort((a, b) => a - b)[22];
    this.frames = [];
    if (middle > SLOW_FRAME && this.quality < QUALITIES.length - 1) {
      this.quality++;
      this.resize();
    }
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
