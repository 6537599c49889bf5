// A chart: lines over iterations or environment steps, with axes, and a cursor that can be dragged.

const SVG = "http://www.w3.org/2000/svg";
const EDGE = { left: 50, right: 10, top: 10, bottom: 32 }; // pixels beside the plot
const DOTS = 40; // most points that are drawn as dots too

function svg(name, attributes, ...inside) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...inside);
  return node;
}

/** Return a number as people read it, with a minus that is as wide as a plus. */
function number(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size && (size < 1e-3 || size >= 1e5) ? value.toExponential(1).replace("e+", "e") : String(Number(value.toPrecision(digits)));
  return text.replace(/-/g, "−");
}

/** Return round numbers between two ends, about so many. */
function ticks(lo, hi, about) {
  const rough = (hi - lo) / about || 1, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((n) => n * power >= rough * 0.999), found = [];
  for (let i = Math.ceil(lo / step - 1e-9); i * step <= hi + step * 1e-9; i++) found.push(i * step);
  return found;
}

/** Return powers of ten between two ends, or more of a scale that has few. */
function logarithmicTicks(lo, hi) {
  const powers = [];
  for (let p = Math.floor(Math.log10(lo)); p <= Math.log10(hi) + 1e-9; p++) powers.push(10 ** p);
  const wide = Math.log10(hi / lo) > 1.5, every = Math.ceil(powers.length / 5);
  const found = wide ? powers.filter((_, i) => i % every === 0) : powers.flatMap((power) => [power, 2 * power, 5 * power]);
  return found.filter((value) => value >= lo * 0.999 && value <= hi * 1.001);
}

/** Return the place of the last of the rising numbers `x` that is no more than `at`; -1 where all are more. */
function lastUpTo(x, at) {
  let lo = 0, hi = x.length;
  while (lo < hi) {
    const middle = (lo + hi) >> 1;
    if (x[middle] <= at + 1e-9) lo = middle + 1;
    else hi = middle;
  }
  return lo - 1;
}

class Chart {
  /** `lines` have a label, a colour, a dash, x by the name of an axis, and y; `seek` is told where the cursor goes. */
  constructor({ title, axis, bounds, logarithmic, lines }, seek) {
    Object.assign(this, { axis, bounds, logarithmic, lines });
    this.node = document.createElement("figure");
    this.node.className = "chart";
    const heading = document.createElement("h2"), legend = document.createElement("ul");
    heading.textContent = title;
    this.values = lines.map(({ label, colour, dash }) => {
      const entry = document.createElement("li"), value = document.createElement("b"), width = 18;
      const swatch = svg("svg", { class: "key", width, height: 6 }, svg("line", { x2: width, y1: 3, y2: 3, stroke: colour, "stroke-width": 2.5, "stroke-dasharray": dash }));
      entry.append(swatch, ` ${label} `, value);
      legend.append(entry);
      return value;
    });
    this.plot = svg("svg", { role: "img", "aria-label": `${title}, ${axis}` });
    this.node.append(heading, legend, this.plot);
    const drag = (event) => {
      const box = this.plot.getBoundingClientRect(), width = box.width - EDGE.left - EDGE.right;
      const share = Math.min(1, Math.max(0, (event.clientX - box.left - EDGE.left) / width));
      seek(this.span[0] + share * (this.span[1] - this.span[0]));
    };
    this.plot.addEventListener("pointerdown", (event) => {
      this.plot.setPointerCapture(event.pointerId);
      drag(event);
    });
    this.plot.addEventListener("pointermove", (event) => this.plot.hasPointerCapture(event.pointerId) && drag(event));
  }

  /** Draw the lines anew over `span` of the axis `along`, which has a name. */
  draw(along, name, span) {
    Object.assign(this, { along, span });
    const width = this.plot.clientWidth || 360, height = this.plot.clientHeight || 158;
    const { left, right, top, bottom } = EDGE, [lo, hi] = this.range(), { logarithmic } = this;
    const scale = logarithmic ? Math.log10 : (value) => value, low = scale(lo), high = scale(hi);
    this.x = (value) => left + ((width - left - right) * (value - span[0])) / (span[1] - span[0] || 1);
    this.y = (value) => height - bottom - ((height - top - bottom) * (scale(value) - low)) / (high - low || 1);
    const parts = [];
    for (const value of logarithmic ? logarithmicTicks(lo, hi) : ticks(lo, hi, 4)) {
      const y = this.y(value).toFixed(1);
      parts.push(svg("line", { class: "grid", x1: left, x2: width - right, y1: y, y2: y }));
      parts.push(svg("text", { x: left - 6, y, dy: "0.35em", "text-anchor": "end" }, number(value, 6)));
    }
    for (const value of ticks(...span, width > 460 ? 8 : 5)) {
      const x = this.x(value).toFixed(1), axis = height - bottom;
      parts.push(svg("line", { class: "grid", x1: x, x2: x, y1: axis, y2: axis + 4 }));
      parts.push(svg("text", { x, y: axis + 15, "text-anchor": "middle" }, along === "env_steps" ? steps(value, span[1]) : number(value, 6)));
    }
    parts.push(svg("text", { x: width - right, y: height - 3, "text-anchor": "end" }, name));
    parts.push(svg("text", { x: 10, y: (height - bottom + top) / 2, transform: `rotate(-90 10 ${(height - bottom + top) / 2})`, "text-anchor": "middle" }, this.axis));
    for (const line of this.lines) parts.push(...this.drawn(line));
    this.cursor = svg("line", { class: "cursor", y1: top - 4, y2: height - bottom });
    this.plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.plot.replaceChildren(...parts, this.cursor);
  }

  /** Return both ends of the upright axis. */
  range() {
    if (this.bounds) return this.bounds;
    let lo = Infinity, hi = -Infinity;
    for (const { y } of this.lines) {
      for (const value of y) {
        if (!Number.isFinite(value)) continue;
        lo = Math.min(lo, value);
        hi = Math.max(hi, value);
      }
    }
    if (lo > hi) return this.logarithmic ? [0.1, 1] : [0, 1];
    if (this.logarithmic) return [lo / 1.15, hi * 1.15];
    const air = (hi - lo || Math.abs(hi) || 1) * 0.06;
    return [lo - air, hi + air];
  }

  drawn({ x, y, colour, dash }) {
    const points = [];
    y.forEach((value, i) => Number.isFinite(value) && points.push(`${this.x(x[this.along][i]).toFixed(1)},${this.y(value).toFixed(1)}`));
    const line = svg("polyline", { class: "line", points: points.join(" "), stroke: colour, "stroke-dasharray": dash });
    if (points.length > DOTS) return [line];
    return [line, ...points.map((point) => svg("circle", { cx: point.split(",")[0], cy: point.split(",")[1], r: 2, fill: colour }))];
  }

  /** Put the cursor at `place`, and say what the lines are there: their last values up to it. */
  move(place) {
    const x = this.x(place).toFixed(1);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    this.lines.forEach(({ x: along, y }, i) => {
      let at = lastUpTo(along[this.along], place);
      while (at >= 0 && !Number.isFinite(y[at])) at--;
      this.values[i].textContent = at < 0 ? "–" : number(y[at]);
    });
  }
}

/** Return a number of environment steps as people read it, in millions or thousands as `most` is. */
function steps(value, most = value) {
  if (most >= 1e6) return `${number(value / 1e6)} M`;
  return most >= 1e4 ? `${number(value / 1e3)} k` : number(value, 6);
}
