// A hand of another phi: the scene's text anew, as the task's `Hand` and its printed parts have it.

const FACET = 50, HEAD = 84; // bytes of a binary STL

/** Return why a hand of phi can't be assembled, or "". */
function whyNot(shaping, phi) {
  const angles = shaping.base_angles.map((angle, i) => angle + phi[i]);
  let nearest = { apart: Infinity };
  angles.forEach((a, i) => angles.slice(i + 1).forEach((b, j) => {
    const apart = 2 * shaping.palm_radius * Math.abs(Math.sin((a - b) / 2));
    if (apart < nearest.apart) nearest = { apart, pair: [i + 1, i + j + 2] };
  }));
  if (nearest.apart >= shaping.spacing) return "";
  const [needed, there] = [shaping.spacing, nearest.apart].map((m) => (1000 * m).toFixed(1));
  return `Fingers ${nearest.pair.join(" and ")} would stand ${there} mm apart on the palm, ${needed} mm are needed: this hand can't be assembled.`;
}

/** Return the design `base` with the hand of phi instead of its own. */
function shaped(base, shaping, phi) {
  const document = new DOMParser().parseFromString(base.xml, "text/xml"), n = shaping.base_angles.length;
  const find = (tag, name) => document.querySelector(`${tag}[name="${name}"]`);
  const set = (element, values) => {
    for (const [key, value] of Object.entries(values)) element.setAttribute(key, [value].flat().join(" "));
  };
  const weigh = (body, moments) => {
    const inertial = find("body", body).querySelector(":scope > inertial");
    for (const old of ["quat", "diaginertia"]) inertial.removeAttribute(old);
    set(inertial, inertialOf(moments, shaping.density));
  };
  const angles = shaping.base_angles.map((angle, i) => angle + phi[i]), lengths = phi.slice(n);
  const files = Object.fromEntries(Object.entries(base.files).filter(([path]) => !path.startsWith("parts/")));
  const wear = (link, content) => {
    const path = `shaped/${link}.stl`, mesh = document.createElement("mesh");
    files[path] = content;
    set(mesh, { name: `${link}_shaped`, file: path, scale: [0.001, 0.001, 0.001] });
    document.querySelector("asset").append(mesh);
    set(find("geom", `${link}_visual`), { mesh: `${link}_shaped` });
  };
  for (const mesh of document.querySelectorAll('mesh[file^="parts/"]')) mesh.remove();

  const [spread, curl] = shaping.spread, reach = Math.max(...lengths) * (Math.cos(spread) + Math.cos(spread - curl));
  const zero = clamp(shaping.clearance + reach, ...shaping.palm_range), range = shaping.palm_range.map((end) => end - zero);
  set(find("body", "palm"), { pos: [0, 0, zero] });
  set(find("joint", "palm"), { range });
  set(find("position", "palm"), { ctrlrange: range });
  weigh("palm", angles.reduce((sum, angle) => added(sum, turned(shaping.each, angle)), shaping.plate));
  wear("palm", joined([bytes(shaping.meshes.plate), ...angles.map((angle) => turnedMesh(bytes(shaping.meshes.mount), angle))]));
  angles.forEach((angle, i) => {
    const length = lengths[i], name = `finger_${i + 1}`;
    const [c, s, cs, ss] = [Math.cos(angle / 2), Math.sin(angle / 2), Math.cos(spread / 2), Math.sin(spread / 2)];
    set(find("body", `${name}_proximal`), {
      pos: [shaping.palm_radius * Math.cos(angle), shaping.palm_radius * Math.sin(angle), 0],
      quat: [c * cs, s * ss, -c * ss, s * cs],
    });
    set(find("body", `${name}_distal`), { pos: [0, 0, -length] });
    for (const kind of ["proximal", "distal"]) {
      set(find("geom", `${name}_${kind}`), { size: [shaping.finger_radius, length / 2], pos: [0, 0, -length / 2] });
      weigh(`${name}_${kind}`, linkMoments(shaping.links[kind], length));
      wear(`${name}_${kind}`, stretched(bytes(shaping.meshes[kind]), shaping.mesh_length, 1000 * length));
    }
  });
  const middle = [shaping.palm_middle - zero, ...base.middle.slice(1)];
  return { ...base, label: "Your φ", xml: new XMLSerializer().serializeToString(document), files, middle, layers: told(base, shaping, phi) };
}

/** Return the layers of the policy as they are on phi, which some policies see. */
function told(base, shaping, phi) {
  if (!base.layers || !shaping.bias_slope) return base.layers;
  const bias = floats(base.layers[0].bias);
  shaping.parameters.forEach(({ value }, i) => {
    shaping.bias_slope[i].forEach((slope, o) => { bias[o] += slope * (phi[i] - value); });
  });
  return [{ ...base.layers[0], bias: text(new Uint8Array(bias.buffer)) }, ...base.layers.slice(1)];
}

// --- moments: integrals over a part's volume, which add up ---

function linkMoments(link, length) {
  const at = (coefficients) => coefficients.reduceRight((sum, c) => sum * length + c, 0);
  return {
    volume: at(link.volume), first: [0, 0, at(link.z)],
    second: [[at(link.xx), 0, 0], [0, at(link.yy), 0], [0, 0, at(link.zz)]],
  };
}

function added(a, b) {
  return {
    volume: a.volume + b.volume, first: a.first.map((x, i) => x + b.first[i]),
    second: a.second.map((row, i) => row.map((x, j) => x + b.second[i][j])),
  };
}

function turned(moments, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), turn = [[c, -s, 0], [s, c, 0], [0, 0, 1]];
  const times = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, x, k) => sum + x * b[k][j], 0)));
  const back = turn.map((_, i) => turn.map((row) => row[i]));
  return {
    volume: moments.volume, first: turn.map((row) => row.reduce((sum, x, k) => sum + x * moments.first[k], 0)),
    second: times(times(turn, moments.second), back),
  };
}

function inertialOf({ volume, first, second }, density) {
  const com = first.map((x) => x / volume), about = second.map((row, i) => row.map((x, j) => x - volume * com[i] * com[j]));
  const trace = about[0][0] + about[1][1] + about[2][2];
  const inertia = (i, j) => density * ((i === j ? trace : 0) - about[i][j]);
  const pairs = [[0, 0], [1, 1], [2, 2], [0, 1], [0, 2], [1, 2]];
  return { pos: com, mass: density * volume, fullinertia: pairs.map(([i, j]) => inertia(i, j)) };
}

// --- meshes: binary STL in millimetres ---

/** Return an STL, as text, whose corners `move` has changed. */
function eachCorner(stl, move) {
  const view = new DataView(stl.buffer);
  for (let facet = HEAD; facet < stl.length; facet += FACET) {
    for (let corner = facet + 12; corner < facet + 48; corner += 12) {
      const moved = move([0, 4, 8].map((k) => view.getFloat32(corner + k, true)));
      moved.forEach((x, i) => view.setFloat32(corner + 4 * i, x, true));
    }
  }
  return stl;
}

const stretched = (stl, from, to) => text(eachCorner(stl, ([x, y, z]) => [x, y, z < -from / 2 ? z - (to - from) : z]));

function turnedMesh(stl, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return eachCorner(stl, ([x, y, z]) => [c * x - s * y, s * x + c * y, z]);
}

function joined(stls) {
  const facets = stls.map((stl) => stl.subarray(HEAD)), size = facets.reduce((sum, part) => sum + part.length, 0);
  const whole = new Uint8Array(HEAD + size);
  new DataView(whole.buffer).setUint32(HEAD - 4, size / FACET, true);
  facets.reduce((at, part) => (whole.set(part, at), at + part.length), HEAD);
  return text(whole);
}

function text(content) {
  let raw = "";
  for (let i = 0; i < content.length; i += 8192) raw += String.fromCharCode(...content.subarray(i, i + 8192));
  return btoa(raw);
}
