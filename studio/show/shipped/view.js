// A world as it is seen: MuJoCo's geoms as three.js draws them, what is touched, and who pulls.

const GEOM = { plane: 0, sphere: 2, capsule: 3, cylinder: 5, box: 6, mesh: 7 }; // mjtGeom
const COLLISION_GROUP = 3; // shapes that stand behind the printed parts
const FRAMING = aroundBall([0.55, -1.25, 0.62], [0, 0, 0.26], 0.62); // m
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
  const corners = model.mesh_vertadr[mesh] * 3, faces = model.mesh_faceadr[mesh] * 3;
  return smooth(
    model.mesh_vert.slice(corners, corners + 3 * model.mesh_vertnum[mesh]),
    model.mesh_face.slice(faces, faces + 3 * model.mesh_facenum[mesh]),
  );
}

/** One world as it is drawn. */
class View {
  constructor(world) {
    this.scene = new THREE.Scene();
    this.world = world;
    this.scene.add(...lights(0.7));
    this.dots = Array.from({ length: 2 * world.rule.fingers }, () => this.dot());
    this.arrow = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 0.1, LIT.button, 0.03, 0.02);
    this.arrow.visible = false;
    this.scene.add(this.arrow);
    this.robot = new THREE.Group();
    this.scene.add(this.robot);
    this.build();
  }

  dot() {
    const shape = (radius, opacity) => new THREE.Mesh(
      new THREE.SphereGeometry(radius, 12, 8),
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
      const material = paint({
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
