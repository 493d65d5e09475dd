// The viewer of a lens: one module, for a page of the local server (`page`) and for a notebook (`default.render`).
//
// `send(event)` carries an event to Python and promises its reply; everything shown is a number of a reply. While a
// slider is dragged one event is under way at a time, and of those that wait only the last is sent.

const NS = "http://www.w3.org/2000/svg";
const SETTLE = 250; // ms after the last change, until slower analyses are asked for
const INKS = { "#262626": "var(--ink)", "#7a7a7a": "var(--grey)", "#d0d0d0": "var(--faint)", "#9a9a9a": "var(--grey)" };
const KINDS = {
  image_f_number: "F-number", entrance_pupil_diameter: "entrance pupil, mm", object_na: "object NA",
  paraxial_working_f_number: "working F-number", object_cone_angle: "object cone, °", float_by_stop: "stop radius, mm",
};
const SIZES = { semi_diameter: "semi-dia.", chip_zone: "chip zone", mechanical_semi_diameter: "mech. s.-d." }; // mm
const MERITS = { "": "merit of the file", spot: "RMS spot", wavefront: "RMS wavefront", angular: "angular", mtf: "MTF, ¼ and ½ of range" };

// -- small parts ------------------------------------------------------------------------------------------------------

function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && name !== "list") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((one) => one !== null));
  return element;
}

function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// A number to so many significant digits, with a real minus sign.
function words(value, digits = 4) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-4 || size >= 1e6) ? value.toExponential(digits - 2) : String(+value.toPrecision(digits));
  return text.replace("-", "−");
}

// As it is typed into a field: enough digits to come back, and ∞.
const unitOf = (lens) => lens.fields.unit.replace("degrees", "°");
const typed = (value) => (value === null ? "∞" : String(+value.toPrecision(9)));

// Whether a number is between the ends of a slider, which a drag to an end may miss by a rounding.
const within = (value, ends) => Boolean(ends) && Math.abs(2 * value - ends.low - ends.high) <= (1 + 1e-9) * (ends.high - ends.low);

// The number of a curve at x; null outside of the curve and where a number is missing.
function between(xs, ys, x) {
  const k = xs.findIndex((one, i) => i > 0 && (one - x) * (xs[i - 1] - x) <= 0);
  if (k < 1 || ys[k] === null || ys[k - 1] === null) return null;
  return xs[k] === xs[k - 1] ? ys[k] : ys[k - 1] + ((ys[k] - ys[k - 1]) * (x - xs[k - 1])) / (xs[k] - xs[k - 1]);
}

function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= raw * 0.999);
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + 1e-9 * step; at += step) found.push(Math.abs(at) < 1e-9 * step ? 0 : at);
  return found;
}

// -- figures ----------------------------------------------------------------------------------------------------------

// Axes of a figure of width × height pixels; returns the group for curves and the scales.
function axes(target, width, height, { x, y, left = 40, bottom = 26, top = 6, right = 12, xlabel = "", ylabel = "", ticksX = 5, ticksY = 4 }) {
  const at = (v) => left + ((v - x[0]) / (x[1] - x[0])) * (width - left - right);
  const up = (v) => height - bottom - ((v - y[0]) / (y[1] - y[0])) * (height - bottom - top);
  const frame = svg("g", { class: "axes" });
  for (const value of ticksX ? ticks(x[0], x[1], ticksX) : []) {
    frame.append(svg("line", { x1: at(value), x2: at(value), y1: top, y2: height - bottom, class: "grid" }));
    const label = svg("text", { x: at(value), y: height - bottom + 11, "text-anchor": "middle" });
    label.textContent = words(value);
    frame.append(label);
  }
  for (const value of ticksY ? ticks(y[0], y[1], ticksY) : []) {
    frame.append(svg("line", { x1: left, x2: width - right, y1: up(value), y2: up(value), class: "grid" }));
    const label = svg("text", { x: left - 4, y: up(value) + 3, "text-anchor": "end" });
    label.textContent = words(value);
    frame.append(label);
  }
  frame.append(svg("rect", { x: left, y: top, width: width - left - right, height: height - bottom - top, class: "frame" }));
  const named = [[xlabel, (left + width - right) / 2, height - 3, "middle"]];
  for (const [text, px, py, anchor] of named) {
    const label = svg("text", { x: px, y: py, "text-anchor": anchor, class: "label" });
    label.textContent = text;
    frame.append(label);
  }
  if (ylabel) {
    const label = svg("text", { transform: `translate(9 ${(top + height - bottom) / 2}) rotate(-90)`, "text-anchor": "middle", class: "label" });
    label.textContent = ylabel;
    frame.append(label);
  }
  target.append(frame);
  const curves = svg("g", { class: "data" });
  target.append(curves);
  const atOf = (px) => x[0] + ((px - left) / (width - left - right)) * (x[1] - x[0]);
  const upOf = (py) => y[0] + ((height - bottom - py) / (height - bottom - top)) * (y[1] - y[0]);
  return { at, up, atOf, upOf, curves };
}

// The path of a curve, broken where a number is missing.
function curve(xs, ys, at, up) {
  let path = "", pen = "M";
  for (let i = 0; i < xs.length; i++) {
    if (ys[i] === null || xs[i] === null) pen = "M";
    else (path += `${pen}${at(xs[i]).toFixed(1)} ${up(ys[i]).toFixed(1)}`), (pen = "L");
  }
  return path;
}

const line = (path, colour, more = {}) => svg("path", { d: path, stroke: colour, fill: "none", ...more });

// A figure; its `read(px, py)` is the read-out under the pointer, lines of text.
function figure(name, title, width, height, label) {
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": label, "data-figure": name });
  return picture;
}

function drawLayout(target, now, stored) {
  const width = target.clientWidth || 760, height = target.clientHeight || 210;
  if (!now.layout) return empty(target, "layout", "no cross section");
  const { shapes, x, y } = now.layout;
  const limits = { x: [...x], y: [...y] };
  if (stored && stored.layout) for (const axis of ["x", "y"]) {
    limits[axis] = [Math.min(limits[axis][0], stored.layout[axis][0]), Math.max(limits[axis][1], stored.layout[axis][1])];
  }
  const scale = Math.min(width / (limits.x[1] - limits.x[0]), height / (limits.y[1] - limits.y[0]));
  const middle = (axis) => (limits[axis][0] + limits[axis][1]) / 2;
  const at = (v) => width / 2 + (v - middle("x")) * scale;
  const up = (v) => height / 2 - (v - middle("y")) * scale;
  const picture = figure("layout", "", width, height, `Cross section with the rays of fields ${now.fields.join(", ")}`);
  const draw = (shape, faint) => {
    const d = curve(shape.points[0], shape.points[1], at, up);
    if (shape.kind === "text") {
      const text = svg("text", { x: at(shape.points[0][0]), y: up(shape.points[1][0]) - 4, "text-anchor": "middle" });
      text.textContent = shape.text;
      return text;
    }
    if (shape.kind === "area") {
      const solid = shape.fill === "#262626";
      return svg("path", { d: d + "Z", class: faint ? "ghost" : solid ? "solid" : "glass", ...(faint || solid ? {} : { fill: shape.fill }) });
    }
    const ray = /ray/.test(shape.id);
    return svg("path", { d, class: ray ? "data" : "", fill: "none", stroke: INKS[shape.stroke] || shape.stroke, "stroke-width": shape.width, ...(shape.dashed ? { "stroke-dasharray": ray ? "4 2" : "9 3 2 3", opacity: ray ? 0.5 : 1 } : {}) });
  };
  picture.read = (px, py) => [`z ${words(middle("x") + (px - width / 2) / scale)} mm`, `y ${words(middle("y") - (py - height / 2) / scale)} mm`];
  if (stored && stored.layout) for (const shape of stored.layout.shapes) if (shape.kind === "area" && /glass/.test(shape.id)) picture.append(draw(shape, true));
  for (const kind of ["area", "line", "mark", "text"]) for (const shape of shapes) if (shape.kind === kind) picture.append(draw(shape, false));
  target.replaceChildren(picture);
}

function empty(target, name, text) {
  target.replaceChildren(make("p", { className: "none", textContent: text, "data-figure": name }));
}

function drawSpots(target, now, stored) {
  const spots = now.spots;
  if (!spots) return empty(target, "spots", "no spots");
  const count = now.fields.length, width = target.clientWidth || 170;
  const size = Math.max(40, Math.min(width - 8, (target.clientHeight || 420) / count - 24));
  const half = 1.12 * Math.max(spots.half, Math.min(spots.airy ?? 0, 4 * spots.half), 1e-6);
  target.replaceChildren();
  now.fields.forEach((field, f) => {
    const rms = spots.rms[f], before = stored && stored.spots ? stored.spots.rms[f] : undefined;
    const text = rms === null ? "no ray arrives" : `RMS ${words(rms)} µm`;
    const picture = figure(`spot-${f}`, "", size, size, `Spot of field ${field}: ${text}`);
    const scale = size / (2 * half);
    picture.read = (px, py) => [`x ${words((px - size / 2) / scale, 3)} µm`, `y ${words((size / 2 - py) / scale, 3)} µm`, "from the centroid"];
    picture.append(svg("rect", { x: 0.5, y: 0.5, width: size - 1, height: size - 1, class: "frame" }));
    if (spots.airy) picture.append(svg("circle", { cx: size / 2, cy: size / 2, r: spots.airy * scale, class: "airy" }));
    const data = svg("g", { class: "data" });
    spots.dots[f].forEach((dots, w) => {
      let path = "";
      for (let i = 0; i < dots.length; i += 2) {
        path += `M${(size / 2 + dots[i] * 1e-3 * spots.half * scale).toFixed(1)} ${(size / 2 - dots[i + 1] * 1e-3 * spots.half * scale).toFixed(1)}h0`;
      }
      data.append(line(path, now.wavelength_colours[w], { "stroke-linecap": "round", "stroke-width": 1.5 }));
    });
    picture.append(data);
    const name = make("b", { style: `color:${now.field_colours[f]}`, textContent: field });
    const short = before === undefined || rms === null ? text : `${words(rms)} µm`;
    const value = make("span", { "data-number": `rms-${f}`, "data-value": rms ?? "", textContent: ` ${short}` });
    const caption = make("div", { className: "caption" }, name, value);
    if (before !== undefined) caption.append(make("span", { className: "was", textContent: ` (${words(before, 3)})` }));
    target.append(make("div", { className: "spot" }, caption, picture));
  });
  const bar = make("div", { className: "caption grey", textContent: `□ ${words(2 * half, 3)}, Airy ○ ${words(2 * spots.airy, 3)} µm` });
  if (spots.half > 0) target.append(bar);
}

const LEFT = 40; // of the numbers of an axis

function drawFans(target, now, stored) {
  const fans = now.fans;
  if (!fans) return empty(target, "fans", "no ray fans");
  const width = target.clientWidth || 300, rows = now.fields.length;
  const height = Math.max(54, Math.floor((target.clientHeight || 420) / rows) - 1);
  const all = [fans, stored && stored.fans].filter(Boolean).map((one) => [one.tangential, one.sagittal]).flat(4).filter((one) => one !== null).map(Math.abs);
  const top = 1.05 * (Math.max(0, ...all) || 1);
  target.replaceChildren();
  now.fields.forEach((field, f) => {
    const picture = figure(`fan-${f}`, "", width, height, `Ray fans of field ${field}, within ±${words(top, 3)} µm`);
    const pupils = [];
    picture.read = (px) => {
      const s = px > LEFT + (width - LEFT) / 2 ? 1 : 0, pupil = pupils[s](px);
      if (Math.abs(pupil) > 1) return [];
      const values = fans[s ? "sagittal" : "tangential"][f].map((one, w) => `${words(now.wavelengths[w])} µm: ${words(between(fans.pupil, one, pupil), 3)} µm`);
      return [`pupil ${s ? "x" : "y"} ${words(pupil, 3)}`, ...values];
    };
    ["tangential", "sagittal"].forEach((section, s) => {
      const part = svg("g", { transform: `translate(${s ? LEFT + (width - LEFT) / 2 : 0} 0)` });
      const last = f === rows - 1;
      const { at, up, atOf, curves } = axes(part, s ? (width - LEFT) / 2 : LEFT + (width - LEFT) / 2, height, {
        x: [-1, 1], y: [-top, top], left: s ? 10 : LEFT, right: 8, top: 14, bottom: last ? 24 : 6,
        ticksX: last ? 2 : 0, ticksY: s ? 0 : 5, xlabel: last ? (s ? "pupil x" : "pupil y") : "",
      });
      pupils.push((px) => atOf(s ? px - LEFT - (width - LEFT) / 2 : px));
      part.append(svg("line", { x1: at(0), x2: at(0), y1: 14, y2: height - (last ? 24 : 6), class: "zero" }), svg("line", { x1: at(-1), x2: at(1), y1: up(0), y2: up(0), class: "zero" }));
      if (stored && stored.fans && stored.fans[section][f]) stored.fans[section][f].forEach((values) => curves.append(line(curve(stored.fans.pupil, values, at, up), "var(--grey)", { "stroke-dasharray": "2 2" })));
      fans[section][f].forEach((values, w) => curves.append(line(curve(fans.pupil, values, at, up), now.wavelength_colours[w], { "stroke-width": 1.3, "data-curve": `${section}-${f}-${w}` })));
      const title = svg("text", { x: s ? 10 : LEFT, y: 10, class: "label" });
      title.textContent = s ? "sagittal" : `${field} tangential`;
      part.append(title);
      picture.append(part);
    });
    target.append(picture);
  });
}

function drawMtf(target, now, stored, highest) {
  const found = now.mtf;
  if (!found) return empty(target, "mtf", "no MTF");
  const width = target.clientWidth || 300, height = target.clientHeight || 200;
  const picture = figure("mtf", "", width, height, `MTF (${found.transfer}) to ${words(found.frequency.at(-1))} cycles per mm`);
  const { at, up, atOf, curves } = axes(picture, width, height, { x: [0, highest], y: [0, 1], left: 30, xlabel: "cycles/mm", ticksY: 5 });
  picture.read = (px) => {
    const frequency = atOf(px), value = (values) => words(between(found.frequency, values, frequency), 3);
    if (frequency < 0 || frequency > found.frequency.at(-1)) return [];
    return [`${words(frequency, 3)}/mm`, ...now.fields.map((field, f) => `${field}: T ${value(found.tangential[f])}, S ${value(found.sagittal[f])}`)];
  };
  if (found.limit) curves.append(line(curve(found.frequency, found.limit, at, up), "var(--grey)", { "stroke-dasharray": "1 3" }));
  for (const [source, was] of [[stored && stored.mtf, true], [found, false]]) if (source) {
    ["tangential", "sagittal"].forEach((section, s) => source[section].forEach((values, f) => {
      const colour = now.field_colours[f % now.field_colours.length];
      const look = was ? { opacity: 0.4, "stroke-width": 1 } : { "stroke-width": 1.5, "data-curve": `${section}-${f}` };
      curves.append(line(curve(source.frequency, values, at, up), colour, { ...look, ...(s ? { "stroke-dasharray": "4 3" } : {}) }));
    }));
  }
  target.replaceChildren(picture);
}

function drawCurvature(target, now, stored, unit) {
  const found = now.curvature;
  if (!found || !found.field.at(-1)) return empty(target, "curvature", "no field curves: the fields are on the axis");
  const width = target.clientWidth || 300, height = target.clientHeight || 200;
  const sources = [found, stored && stored.curvature].filter(Boolean);
  const all = sources.flatMap((one) => [one.tangential, one.sagittal].flat(2)).filter((one) => one !== null).map(Math.abs);
  const top = 1.05 * (Math.max(0, ...all) || 1), largest = found.field.at(-1);
  const picture = figure("curvature", "", width, height, `Field curvature within ±${words(top, 3)} mm`);
  const { at, up, upOf, curves } = axes(picture, width, height, { x: [-top, top], y: [Math.min(0, largest), Math.max(0, largest)], left: 40, xlabel: "focus from the sensor, mm", ylabel: `field, ${unit}`, ticksX: 4 });
  picture.read = (px, py) => {
    const field = upOf(py), value = (values) => words(between(found.field, values, field), 3);
    if (between(found.field, found.field, field) === null) return [];
    return [`field ${words(field, 3)} ${unit}`, ...now.wavelengths.map((one, w) => `${words(one)} µm: T ${value(found.tangential[w])}, S ${value(found.sagittal[w])} mm`)];
  };
  picture.append(svg("line", { x1: at(0), x2: at(0), y1: up(0), y2: up(largest), class: "zero" }));
  for (const [source, was] of [[stored && stored.curvature, true], [found, false]]) if (source) {
    ["tangential", "sagittal"].forEach((section, s) => source[section].forEach((values, w) => {
      const look = was ? { opacity: 0.4, "stroke-width": 1 } : { "stroke-width": 1.5 };
      curves.append(line(curve(values, source.field, at, up), now.wavelength_colours[w % now.wavelength_colours.length], { ...look, ...(s ? { "stroke-dasharray": "4 3" } : {}) }));
    }));
  }
  target.replaceChildren(picture);
}

function drawMerit(target, merits) {
  if (merits.length < 2) return target.replaceChildren();
  const logs = merits.map((one) => Math.log10(Math.max(one, 1e-300))), low = Math.min(...logs), high = Math.max(...logs);
  const picture = figure("merit", "", 90, 22, `Merit by cycle, from ${words(merits[0])} to ${words(merits.at(-1))}`);
  const at = (v) => 2 + (v / (logs.length - 1)) * 86, up = (v) => 20 - ((v - low) / (high - low || 1)) * 18;
  picture.append(line(curve(logs.map((_, i) => i), logs, at, up), "var(--accent)", { "stroke-width": 1.5 }));
  target.replaceChildren(picture);
}

// -- the viewer -------------------------------------------------------------------------------------------------------

class Viewer {
  constructor(root, send, keys) {
    this.root = root;
    this.transport = send;
    this.keys = keys; // whose keys are the viewer's: all of a page, else those of the cell
    root.tabIndex = -1; // a click beside the controls gives the keys to the cell
    this.waiting = null;
    this.busy = false;
    this.signature = "";
    this.ranges = new Map();
    this.moreNumbers = false;
    this.build();
    this.say("loading; the first time on a machine the trace is compiled, which takes a minute or two", false);
    this.event({ type: "open" });
  }

  build() {
    const button = (text, title, action) => make("button", { type: "button", textContent: text, title, onclick: action });
    this.undo = button("↶ Undo", "Undo (Ctrl+Z)", () => this.event({ type: "undo" }));
    this.redo = button("↷ Redo", "Redo (Ctrl+Shift+Z)", () => this.event({ type: "redo" }));
    this.restore = button("Restore", "Back to the stored lens; can be undone", () => this.event({ type: "restore" }));
    this.compare = make("input", { type: "checkbox", onchange: () => this.event({ type: "compare", on: this.compare.checked }) });
    this.merit = make("select", { "aria-label": "merit function", onchange: () => this.event({ type: "merit", kind: this.merit.value }) });
    this.optimise = button("Optimise", "Optimise the ticked variables (Ctrl+Enter)", () => this.toggleOptimise());
    this.meritCurve = make("span", { className: "merit" });
    this.path = make("input", { type: "text", "aria-label": "file to write", className: "path", spellcheck: false, onkeydown: (e) => e.key === "Enter" && this.save() });
    this.replace = make("input", { type: "checkbox" });
    this.message = make("div", { className: "message", role: "status", "aria-live": "polite" });
    this.latency = make("span", { className: "latency", title: "the last event: computing its numbers, and from request to reply" });
    this.title = make("h1", { textContent: "Lens" });
    this.conditions = make("div", { className: "conditions" });
    this.table = make("div", { className: "table" });
    this.more = make("input", { type: "checkbox", onchange: () => { this.moreNumbers = this.more.checked; this.signature = ""; this.prescription(this.last.prescription); } });
    this.paraxial = make("dl", { className: "paraxial" });
    this.figures = {};
    const lines = () => make("span", { className: "grey", title: "tangential solid, sagittal dashed", textContent: "T ── S ╌╌" });
    const panel = (name, title, ...extra) => {
      this.figures[name] = make("div", { className: `figure ${name}` });
      return make("section", { className: `panel ${name}`, "aria-label": title }, make("h2", {}, make("span", { textContent: title }), ...extra), this.figures[name]);
    };
    this.frequency = make("input", { type: "text", className: "short", "aria-label": "highest frequency, cycles/mm", onchange: () => this.event({ type: "frequency", value: this.frequency.value }) });
    this.transfer = make("span", { className: "grey" });
    this.wavelengthKey = make("span", { className: "key" });
    this.fieldKey = make("span", { className: "key" });
    this.readout = make("div", { className: "readout", hidden: true });
    this.problems = make("ul", { className: "problems", "aria-label": "remarks" });
    this.held = make("section", { className: "held", "aria-label": "conditions" });
    this.root.classList.add("raytrace-viewer");
    const system = matchMedia("(prefers-color-scheme: dark)"), { body } = document;
    const paint = () => this.root.classList.toggle("dark", body.dataset.jpThemeLight ? body.dataset.jpThemeLight === "false" : system.matches || body.classList.contains("vscode-dark"));
    system.addEventListener("change", paint);
    new MutationObserver(paint).observe(body, { attributes: true, attributeFilter: ["data-jp-theme-light", "class"] });
    paint();
    this.root.replaceChildren(
      make("header", {}, this.title,
        make("span", { className: "group" }, this.undo, this.redo, this.restore),
        make("label", {}, this.compare, " compare"),
        make("span", { className: "group" }, this.merit, this.optimise, this.meritCurve),
        make("span", { className: "group save" }, this.path, this.saving = button("Save", "", () => this.save()), make("label", { title: "write over a file that exists" }, this.replace, " replace"))),
      this.message,
      make("div", { className: "columns" },
        this.left = make("div", { className: "left" }, this.conditions, this.table, this.held, this.problems),
        make("div", { className: "right" },
          panel("layout", "Layout", this.fieldKey),
          this.paraxial,
          make("div", { className: "panels" },
            panel("spots", "Spots"), panel("fans", "Ray fans, µm", this.wavelengthKey),
            make("div", { className: "stack" }, panel("mtf", "MTF", lines(), this.transfer, make("label", { className: "grey" }, "to", this.frequency, "/mm")), panel("curvature", "Field curves", lines()))))),
      make("footer", {}, make("span", { textContent: "☑ variable, S solved · Tab moves, arrows turn a slider or step a number · Ctrl+Z undo · Ctrl+Enter optimise" }), this.latency),
      this.readout);
    this.root.addEventListener("pointermove", (e) => this.read(e));
    this.root.addEventListener("pointerleave", () => (this.readout.hidden = true));
    this.keys.addEventListener("keydown", (e) => this.key(e));
    const observer = new ResizeObserver(() => this.last && this.draw());
    for (const one of Object.values(this.figures)) observer.observe(one);
  }

  // The numbers of the figure under the pointer, beside it.
  read(e) {
    const picture = e.target.closest(".figure svg"), box = picture && picture.getBoundingClientRect();
    const lines = picture && picture.read ? picture.read(e.clientX - box.left, e.clientY - box.top) : [];
    this.readout.hidden = lines.length === 0;
    this.readout.textContent = lines.join("\n");
    const { width, height } = this.readout.getBoundingClientRect();
    this.readout.style.left = `${e.clientX + (e.clientX + width + 20 > innerWidth ? -width - 12 : 14)}px`;
    this.readout.style.top = `${e.clientY + (e.clientY + height + 20 > innerHeight ? -height - 12 : 14)}px`;
  }

  key(e) {
    if (!(e.ctrlKey || e.metaKey)) return;
    const key = e.key.toLowerCase();
    if (key === "z" || key === "y") {
      const { dataset, value } = e.target;
      if (dataset.shown !== undefined && dataset.shown !== value) return; // the text that is being typed
      e.preventDefault();
      e.stopPropagation(); // a notebook has the same keys
      this.event({ type: key === "y" || e.shiftKey ? "redo" : "undo" });
    } else if (key === "enter") {
      e.preventDefault();
      e.stopPropagation();
      this.toggleOptimise();
    }
  }

  // One event at a time; of drags that wait only the last is kept.
  event(event) {
    if (this.busy) {
      this.queue = (this.queue || []).filter((one) => !(one.drag && event.drag));
      this.queue.push(event);
      return;
    }
    this.run(event);
  }

  async run(event) {
    this.busy = true;
    this.root.setAttribute("aria-busy", "true");
    clearTimeout(this.settling);
    const started = performance.now();
    try {
      const reply = await this.transport(event);
      this.receive(reply, event, performance.now() - started);
    } catch (error) {
      this.say(`no answer: ${error.message}; has the server ended?`, true);
      this.unsettled = undefined;
    }
    this.busy = false;
    if (this.queue && this.queue.length) return this.run(this.queue.shift());
    this.root.setAttribute("aria-busy", "false");
    const settle = () => this.event({ type: "settle", field: this.unsettled });
    if (this.unsettled !== undefined && !this.running) this.settling = setTimeout(settle, event.type === "settle" ? 0 : SETTLE);
  }

  receive(reply, event, waited) {
    if (reply.message || !["settle", "progress"].includes(event.type)) this.say(reply.message, !/^written/.test(reply.message));
    if (reply.path) {
      this.path.value = this.path.title = reply.path;
      this.saving.title = `Write the lens; the suffix selects the format: ${reply.formats.join(" ")}`;
    }
    if (reply.analyses) {
      this.last = reply;
      this.prescription(reply.prescription, reply.refused);
      this.draw();
      this.latency.textContent = `computed in ${reply.milliseconds.toFixed(0)} ms, replied after ${waited.toFixed(0)} ms`;
      this.root.dataset.milliseconds = reply.milliseconds;
      this.unsettled = 0; // the next field whose slower analyses are missing, null for the remarks
      this.root.dataset.count = 1 + Number(this.root.dataset.count || 0);
    }
    if (event.type === "settle") this.settled(reply, event);
    if ("optimisation" in reply) this.optimised(reply.optimisation);
  }

  // Slower analyses, one field after the other, until something else happens.
  settled(reply, event) {
    if (event.field === 0 || !this.slow) this.slow = { mtf: [], stored_mtf: [] };
    for (const [name, shown] of [["stored_mtf", this.last.stored], ["mtf", this.last.analyses]]) if (reply[name] && shown && shown.mtf) {
      const found = this.slow[name];
      found[event.field] = reply[name];
      if (found.filter(Boolean).length === shown.fields.length) {
        const mtf = { ...found[0], tangential: found.map((one) => one.tangential[0]), sagittal: found.map((one) => one.sagittal[0]) };
        if (found.some((one) => one.transfer !== found[0].transfer)) mtf.transfer = "diffraction, in part geometric";
        shown.mtf = mtf;
        this.draw();
      }
    }
    if (reply.remarks) {
      this.last.problems.push(...reply.remarks);
      this.listProblems(this.last.problems);
      this.root.dataset.settled = this.root.dataset.count;
    }
    const next = event.field + 1;
    this.unsettled = event.field === null ? undefined : next < this.last.analyses.fields.length ? next : null;
  }

  say(text, wrong = true) {
    this.message.textContent = text || "";
    this.message.classList.toggle("wrong", Boolean(text) && wrong);
  }

  listProblems(remarks) {
    this.problems.replaceChildren(...remarks.map((text) => make("li", { textContent: text })));
  }

  draw() {
    const now = this.last.analyses, stored = this.last.stored;
    this.listProblems(this.last.problems);
    this.listParaxial(now, stored);
    drawLayout(this.figures.layout, now, stored);
    drawSpots(this.figures.spots, now, stored);
    drawFans(this.figures.fans, now, stored);
    drawMtf(this.figures.mtf, now, stored, this.last.prescription.frequency);
    drawCurvature(this.figures.curvature, now, stored, unitOf(this.last.prescription));
    this.transfer.textContent = now.mtf ? now.mtf.transfer : "";
    const key = (names, colours) => names.map((name, k) => make("span", { style: `--colour:${colours[k]}`, textContent: name }));
    const all = this.last.prescription.fields.y.length, drawn = now.fields.length;
    this.fieldKey.replaceChildren(drawn < all ? make("i", { textContent: `${drawn} of ${all} fields` }) : "", ...key(now.fields, now.field_colours));
    this.wavelengthKey.replaceChildren(...key(now.wavelengths.map((one) => `${words(one)}`), now.wavelength_colours));
  }

  listParaxial(now, stored) {
    this.paraxial.replaceChildren(...(now.first_order || []).map((one, k) => {
      if (one.name === "m" && one.value === 0) return ""; // the object is at infinity
      const was = stored && stored.first_order ? stored.first_order[k].value : undefined;
      const value = make("dd", { textContent: one.words || `${words(one.value, 5)} ${one.unit}`, "data-number": one.name, "data-value": one.value ?? "" });
      if (was !== undefined && was !== one.value) value.append(make("span", { className: "was", textContent: ` (${words(was, 4)})` }));
      return make("div", {}, make("dt", { textContent: one.name }), value);
    }));
  }

  // -- the prescription

  prescription(lens, refused = false) {
    const columns = this.columnsOf(lens);
    const signature = JSON.stringify([columns, lens.rows.length, this.showsX(lens), lens.configurations, lens.rows.map((row) => [row.follows, row.glass === null, Object.keys(row.cells)])]);
    if (signature !== this.signature) {
      this.signature = signature;
      this.buildTable(lens, columns);
      this.buildConditions(lens);
    }
    this.title.textContent = this.title.title = lens.name || "Lens";
    this.undo.disabled = !lens.undo;
    this.redo.disabled = !lens.redo;
    this.compare.checked = lens.compare;
    const merits = Object.keys(MERITS).filter((kind) => kind || lens.file_merit);
    if (this.merit.options.length !== merits.length) this.merit.replaceChildren(...merits.map((kind) => make("option", { value: kind, textContent: MERITS[kind] })));
    this.merit.value = lens.merit;
    this.show(this.frequency, words(lens.frequency), refused);
    for (const control of this.controls) control(lens, refused);
    this.listHeld(lens.conditions, refused);
  }

  // Conditions of the lens, which Optimise meets exactly, and boundaries of its merit function.
  listHeld(found, refused) {
    const signature = JSON.stringify(found);
    if (signature === this.heldSignature && !refused) return;
    this.heldSignature = signature;
    const send = (parts) => this.event({ type: "condition", ...parts });
    const rows = found.map((one, number) => {
      const value = make("span", { className: one.met ? "" : "missed", "data-condition-value": one.words, textContent: one.on ? `${words(one.reached, 6)}${one.met ? "" : ", not met"}` : "off" });
      if (one.row) return make("div", { className: "row" }, make("span", { className: "grey", textContent: one.words }), value);
      const text = make("input", { type: "text", value: one.words, "aria-label": `condition ${number + 1}`, spellcheck: false, onchange: () => send({ number, words: text.value }) });
      const on = make("input", { type: "checkbox", checked: one.on, "aria-label": `condition ${number + 1} is met`, title: "met by Optimise", onchange: () => send({ number, on: on.checked }) });
      const remove = make("button", { type: "button", textContent: "✕", title: `Remove ${one.words}`, "aria-label": `remove condition ${number + 1}`, onclick: () => send({ number, remove: true }) });
      return make("div", { className: "row" }, on, text, value, remove);
    });
    const added = make("input", { type: "text", placeholder: "efl=50  total_track<=80  edge>=1", "aria-label": "new condition", spellcheck: false, onchange: () => added.value.trim() && send({ words: added.value }) });
    this.held.replaceChildren(make("h2", { textContent: "Conditions" }), ...rows, make("div", { className: "row" }, added));
  }

  columnsOf(lens) {
    const names = ["curvature", "thickness", "glass"];
    for (const row of lens.rows) for (const [name, value] of Object.entries(row.cells)) {
      const shown = this.moreNumbers || value || row.vary.includes(name) || row.follows.includes(name);
      if (!names.includes(name) && shown) names.push(name);
    }
    const isPart = lens.rows.some((row) => row.chip_zone || row.fixed.includes("mechanical_semi_diameter"));
    const sizes = Object.keys(SIZES).filter((name) => this.moreNumbers || (isPart && (name !== "chip_zone" || lens.rows.some((row) => row.chip_zone))));
    return [...names, ...sizes];
  }

  // A text field shows its number, unless something else is typed into it at the moment.
  show(input, text, refused = false) {
    const isTyping = document.activeElement === input && input.value !== input.dataset.shown && !input.dataset.sent && !refused;
    if (!isTyping) input.value = text;
    input.dataset.shown = text;
    delete input.dataset.sent;
  }

  buildTable(lens, columns) {
    this.controls = [];
    const titles = { curvature: "radius, mm", thickness: "thickness, mm", glass: "glass", ...SIZES };
    const head = make("tr", {}, make("th", { scope: "col", textContent: "#" }), ...columns.map((name) => make("th", { scope: "col", textContent: titles[name] || name.replaceAll("_", " ") })));
    const body = lens.rows.map((row) => make("tr", { title: row.comment || "" },
      make("th", { scope: "row", textContent: row.stop ? `${row.surface} stop` : row.surface === 0 ? "object" : row.surface === lens.rows.length - 1 ? "image" : row.surface }),
      ...columns.map((name) => this.cell(row, name))));
    this.table.replaceChildren(make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
  }

  cell(row, name) {
    const surface = row.surface;
    if (name === "glass") {
      if (row.glass === null) return make("td", {});
      const input = make("input", { type: "text", className: "glass", placeholder: "air", spellcheck: false, "aria-label": `glass behind surface ${surface}`, "data-cell": `glass:${surface}` });
      input.addEventListener("change", () => this.edit(surface, "glass", input.value, input));
      this.controls.push((lens, refused) => this.show(input, lens.rows[surface].glass || "", refused));
      return make("td", {}, input);
    }
    if (name in SIZES) {
      const size = name.replace("semi_", "semi-").replaceAll("_", " ");
      const input = make("input", { type: "text", className: "size", "aria-label": `${size} of surface ${surface}, mm`, "data-cell": `${name}:${surface}` });
      input.addEventListener("change", () => this.edit(surface, name, input.value, input));
      this.controls.push((lens, refused) => {
        const value = lens.rows[surface][name], follows = name !== "chip_zone" && !lens.rows[surface].fixed.includes(name);
        input.classList.toggle("automatic", follows);
        input.title = follows ? "mm, automatic; a number that is typed is fixed" : name === "chip_zone" ? "mm" : "mm, fixed; an empty field is automatic";
        this.show(input, value === null || (name === "chip_zone" && value === 0) ? "" : follows ? words(value, 5) : typed(value), refused);
      });
      return make("td", {}, input);
    }
    if (!(name in row.cells)) return make("td", {});
    const radius = name === "curvature", quantity = radius ? "radius" : name, label = `${quantity} of surface ${surface}`;
    const follows = row.follows.includes(name);
    const input = make("input", { type: "text", inputMode: "decimal", "aria-label": label, "data-cell": `${quantity}:${surface}`, disabled: follows });
    const slider = make("input", { type: "range", min: 0, max: 1000, step: 1, "aria-label": `${label}, slider`, "data-slider": `${name}:${surface}`, disabled: follows });
    const vary = make("input", { type: "checkbox", title: `${label} varies`, "aria-label": `${label} varies`, "data-vary": `${name}:${surface}`, disabled: follows });
    const shownAs = (value) => (radius ? (value === 0 ? "∞" : typed(1 / value)) : typed(value));
    const key = `${name}:${surface}`;
    const range = () => this.ranges.get(key);
    input.addEventListener("change", () => this.edit(surface, quantity, input.value, input));
    input.addEventListener("keydown", (e) => {
      if (!["ArrowUp", "ArrowDown"].includes(e.key) || e.ctrlKey) return;
      e.preventDefault();
      const now = this.last.prescription.rows[surface].cells[name];
      if (now === null) return;
      const step = (range().high - range().low) / (e.shiftKey ? 1000 : 100);
      input.dataset.sent = 1;
      this.edit(surface, name, now + (e.key === "ArrowUp" ? step : -step), input);
    });
    const moved = (drag) => {
      const { low, high } = range();
      const value = low + ((high - low) * slider.value) / 1000;
      slider.setAttribute("aria-valuetext", `${words(radius ? 1 / value : value, 5)} mm`);
      this.event({ type: "edit", surface, quantity: name, value, drag });
    };
    slider.addEventListener("input", () => { slider.dataset.held = 1; moved(true); });
    slider.addEventListener("change", () => { delete slider.dataset.held; moved(false); });
    vary.addEventListener("change", () => this.event({ type: "vary", surface, quantity: name, on: vary.checked }));
    this.controls.push((lens, refused) => {
      const value = lens.rows[surface].cells[name], ends = lens.rows[surface].sliders[name];
      this.show(input, shownAs(value), refused);
      const waits = (this.queue || []).some((one) => one.type === "vary" && one.surface === surface && one.quantity === name);
      if (!waits) vary.checked = lens.rows[surface].vary.includes(name);
      slider.hidden = value === null;
      vary.hidden = value === null || surface === lens.rows.length - 1;
      if (value === null || slider.dataset.held) return;
      let known = range();
      if (!within(value, known)) this.ranges.set(key, (known = { low: ends[0], high: ends[1] }));
      slider.title = `${name.replaceAll("_", " ")} from ${words(known.low)} to ${words(known.high)}`;
      slider.value = Math.round((1000 * (value - known.low)) / (known.high - known.low));
      slider.setAttribute("aria-valuetext", `${shownAs(value)}`);
    });
    const mark = follows ? make("span", { className: "follows", title: "follows by a solve or pickup of the file", textContent: "S" }) : vary;
    return make("td", { className: "number" }, make("div", {}, mark, input), slider);
  }

  edit(surface, quantity, value, input) {
    if (input) input.dataset.sent = 1;
    this.event({ type: "edit", surface, quantity, value });
  }

  buildConditions(lens) {
    const field = (label, name, event, show) => {
      const input = make("input", { type: "text", "data-condition": name, spellcheck: false });
      input.addEventListener("change", () => { input.dataset.sent = 1; this.event(event(input.value)); });
      this.controls.push((now, refused) => this.show(input, show(now), refused));
      return make("label", { className: name }, make("span", { textContent: label }), input);
    };
    const select = (label, event, options, chosen) => {
      const input = make("select", { "aria-label": label, onchange: () => this.event(event(input.value)) });
      this.controls.push((now) => {
        const pairs = options(now);
        if (JSON.stringify(pairs) !== input.dataset.pairs) input.replaceChildren(...pairs.map(([value, textContent]) => make("option", { value, textContent })));
        input.dataset.pairs = JSON.stringify(pairs);
        input.value = chosen(now);
      });
      return input;
    };
    const slide = (name, send, at, ends) => {
      const slider = make("input", { type: "range", min: 0, max: 1000, step: 1, "aria-label": `${name}, slider`, "data-slider": name });
      let low, high;
      const moved = (drag) => this.event({ ...send, value: low + ((high - low) * slider.value) / 1000, drag });
      slider.addEventListener("input", () => { slider.dataset.held = 1; moved(true); });
      slider.addEventListener("change", () => { delete slider.dataset.held; moved(false); });
      this.controls.push((now) => {
        const value = at(now);
        if (slider.dataset.held) return;
        if (!within(value, { low, high })) [low, high] = ends(now);
        slider.title = `${name} from ${words(low)} to ${words(high)}`;
        slider.value = Math.round((1000 * (value - low)) / (high - low));
        slider.setAttribute("aria-valuetext", words(value, 5));
      });
      return slider;
    };
    const unit = unitOf(lens), listed = (numbers) => numbers.map(typed).join(", "), numbered = (count) => Array.from({ length: count }, (_, k) => [k + 1, k + 1]);
    const fields = (axis) => field(this.showsX(lens) ? `fields ${axis}, ${unit}` : `fields, ${unit}`, axis === "y" ? "fields" : "fields-x", (values) => ({ type: "fields", axis, values }), (now) => listed(now.fields[axis]));
    const rows = [
      this.showsX(lens) ? [fields("x"), fields("y")] : [fields("y")],
      [field("wavelengths, µm", "wavelengths", (values) => ({ type: "wavelengths", values }), (now) => listed(now.wavelengths)),
        make("label", {}, make("span", { textContent: "primary" }), select("primary wavelength", (value) => ({ type: "primary", number: Number(value) }), (now) => now.wavelengths.map((one, k) => [k + 1, words(one, 5)]), (now) => now.primary))],
      [select("kind of aperture", (kind) => ({ type: "aperture", kind }), (now) => now.aperture.kinds.map((one) => [one, KINDS[one] || one]), (now) => now.aperture.kind),
        field("", "aperture", (value) => ({ type: "aperture", value }), (now) => typed(now.aperture.value)), slide("aperture", { type: "aperture" }, (now) => now.aperture.value, (now) => now.aperture.slider)],
      [make("label", { className: "more" }, this.more, " all numbers (conic, asphere, tilt, …)")],
    ];
    if (lens.configurations > 1) rows[3].push(make("label", {}, make("span", { textContent: "configuration" }), select("configuration", (value) => ({ type: "configuration", number: Number(value) }), (now) => numbered(now.configurations), (now) => now.configuration)));
    this.conditions.replaceChildren(...rows.map((parts) => make("div", { className: "row" }, ...parts)));
    this.conditions.querySelector("[data-condition=aperture]").ariaLabel = "size of the aperture";
  }

  // Whether the x of the fields has a text field of its own.
  showsX(lens) {
    return this.moreNumbers || lens.fields.x.some((one) => one !== 0);
  }

  // -- optimising and saving

  toggleOptimise() {
    this.event({ type: this.running ? "stop" : "optimise" });
  }

  optimised(found) {
    this.running = Boolean(found && found.running);
    clearTimeout(this.polling);
    this.optimise.textContent = this.running ? "Stop" : "Optimise";
    this.root.classList.toggle("running", this.running);
    if (this.running && this.left.contains(document.activeElement)) this.optimise.focus();
    this.left.inert = this.running;
    for (const one of [this.restore, this.merit]) one.disabled = this.running;
    if (this.running) this.undo.disabled = this.redo.disabled = true;
    if (!found) return;
    drawMerit(this.meritCurve, found.merits);
    if (!this.message.classList.contains("wrong")) this.say(`${this.running ? "optimising: " : "optimised: "}${found.words}`, false);
    this.root.dataset.cycles = found.cycles;
    if (this.running) this.polling = setTimeout(() => this.event({ type: "progress", cycles: found.cycles }), 60);
  }

  save() {
    this.event({ type: "save", path: this.path.value, overwrite: this.replace.checked });
  }
}

// -- where it runs ----------------------------------------------------------------------------------------------------

// A page of the local server. A tab keeps its session through a reload; a duplicate of the tab, which begins with a copy
// of its storage, has another one: the lock of a name is held by one tab.
function sessionName() {
  const name = sessionStorage.getItem("raytrace") || crypto.randomUUID();
  sessionStorage.setItem("raytrace", name);
  return new Promise((answer) => navigator.locks.request(name, { ifAvailable: true }, (lock) => {
    if (lock) return answer(name), new Promise(() => {});
    sessionStorage.removeItem("raytrace");
    answer(sessionName());
  }));
}

export function page(root, token) {
  const session = sessionName();
  return new Viewer(root, async (event) => {
    const reply = await fetch(`event?token=${token}`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ session: await session, event }) });
    if (!reply.ok) throw new Error(await reply.text());
    return reply.json();
  }, document);
}

// A cell of a notebook.
function render({ model, el }) {
  const open = new Map();
  let number = 0;
  const receive = (message) => {
    const answer = open.get(message.number);
    open.delete(message.number);
    if (answer) answer(message.reply);
  };
  model.on("msg:custom", receive);
  new Viewer(el, (event) => new Promise((answer) => {
    open.set(++number, answer);
    model.send({ number, event });
  }), el);
  return () => model.off("msg:custom", receive);
}

export default { render };
