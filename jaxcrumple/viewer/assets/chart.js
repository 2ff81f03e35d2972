"use strict";
// Energies by term over time, with the stages of the run, as SVG.

const STAGES = { quasistatic: "#1f6fb4", implicit: "#e8a33d", explicit: "#d9541e" };
const LEFT = 46, RIGHT = 4, TOP = 14, BOTTOM = 18, DECADES = 6;

function svg(name, attributes, parent, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

class Chart {
  constructor(element, about, colours, end, seek) {
    Object.assign(this, { element, history: about.history, colours, end });
    element.addEventListener("pointerdown", (event) => { element.setPointerCapture(event.pointerId); seek(this._time(event)); });
    element.addEventListener("pointermove", (event) => { if (event.buttons & 1) seek(this._time(event)); });
    new ResizeObserver(() => this.draw()).observe(element);
    this.now = 0;
  }

  _time(event) {
    const box = this.element.getBoundingClientRect();
    const share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
    return Math.min(Math.max(share, 0), 1) * this.end;
  }

  _across(t) { return LEFT + (t / this.end) * (this.width - LEFT - RIGHT); }

  draw() {
    const { element, history } = this;
    element.replaceChildren();
    this.width = element.clientWidth;
    this.height = element.clientHeight;
    if (!history.t.length) { svg("text", { x: LEFT, y: 30 }, element, "no steps yet"); this.cursor = null; return; }
    this._stages();
    const energies = Object.entries(history.energies);
    const top = Math.max(...energies.flatMap(([, values]) => values.map(Math.abs)), 1e-30);
    const high = Math.ceil(Math.log10(top)), low = high - DECADES;
    const down = (value) => TOP + ((high - Math.log10(Math.max(value, 10 ** low))) / DECADES) * (this.height - TOP - BOTTOM);
    for (let power = low; power <= high; power += 2) {
      svg("line", { x1: LEFT, x2: this.width - RIGHT, y1: down(10 ** power), y2: down(10 ** power), stroke: "#e5e9ee" }, element);
      svg("text", { x: LEFT - 4, y: down(10 ** power) + 4, "text-anchor": "end" }, element, `1e${power} J`);
    }
    energies.forEach(([name, values], i) => {
      const points = values.map((value, k) => `${this._across(history.t[k]).toFixed(1)},${down(Math.abs(value)).toFixed(1)}`);
      svg("polyline", { points: points.join(" "), fill: "none", stroke: this.colours[name], "stroke-width": 1.4 }, element);
      const x = LEFT + 4 + 66 * i;
      svg("line", { x1: x, x2: x + 10, y1: this.height - 8, y2: this.height - 8, stroke: this.colours[name], "stroke-width": 3 }, element);
      svg("text", { x: x + 13, y: this.height - 4 }, element, name);
    });
    svg("text", { x: this.width - RIGHT, y: this.height - 4, "text-anchor": "end" }, element, `${+this.end.toPrecision(3)} s`);
    this.cursor = svg("line", { y1: 0, y2: this.height - BOTTOM, stroke: "#1b1f24", "stroke-width": 1.5 }, element);
    this.move(this.now);
  }

  // A strip of the stages above the energies.
  _stages() {
    const { t, stage } = this.history;
    for (let first = 0, k = 1; k <= t.length; k++) {
      if (k < t.length && stage[k] === stage[first]) continue;
      const from = this._across(first ? t[first - 1] : 0), to = this._across(t[k - 1]);
      const strip = svg("rect", { x: from, y: 2, width: Math.max(to - from, 0.5), height: 6, fill: STAGES[stage[first]] }, this.element);
      svg("title", {}, strip, stage[first]);
      first = k;
    }
  }

  move(t) {
    this.now = t;
    if (!this.cursor) return;
    const x = this._across(Math.min(t, this.end));
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
  }

  // Row of the history at time t, in words.
  describe(t) {
    const { history } = this;
    if (!history.t.length) return "";
    let row = history.t.findIndex((value) => value >= t);
    if (row < 0) row = history.t.length - 1;
    const joule = (value) => `${(1e3 * value).toPrecision(3)} mJ`;
    const parts = ["bending", "stretch", "contact"].filter((name) => name in history.energies);
    return [`${history.stage[row]}, step ${history.h[row].toPrecision(2)} s`, ...parts.map((name) => `${name} ${joule(history.energies[name][row])}`)].join(", ");
  }
}
