"use strict";
// Build the page: a panel for each run, and one clock for all.

const $ = (name) => document.getElementById(name);

function tell(text) {
  $("message").textContent = text;
  $("message").hidden = false;
}

// Two significant digits, without an exponent where it can be.
function short(value) {
  return String(+value.toPrecision(2));
}

function section(about, number) {
  const element = document.createElement("section");
  element.className = "run";
  element.innerHTML = `<h2></h2><p class="about"></p>
    <div class="views">
      <div class="view space" tabindex="0" role="group"><span class="bar"></span></div>
      <div class="view pattern" tabindex="0" role="application"><span class="caption">mountains: lines, valleys: dashes</span><span class="bar"></span></div>
    </div>
    <p class="status" id="status-${number}"></p>
    <svg class="chart" role="img" aria-describedby="status-${number}"></svg>`;
  const frames = about.t.length;
  element.querySelector("h2").textContent = about.name;
  element.querySelector(".about").textContent = `${about.about}; ${frames} frames; ${about.result}`;
  element.querySelector(".space").setAttribute("aria-label", `Sheet of ${about.name} in space; drag to turn, or Shift and arrow keys; scroll to zoom`);
  element.querySelector(".pattern").setAttribute("aria-label", `Crease pattern of ${about.name} on the flat sheet; arrow keys move a mark, Escape removes it`);
  element.querySelector(".chart").setAttribute("aria-label", `Energies of ${about.name} over time; click to go to a time`);
  $("runs").append(element);
  return element;
}

class Page {
  constructor(about, surfaces) {
    this.palette = about.palette;
    this.tables = { true: linear(about.palette.signed), false: linear(about.palette.plain) };
    this.field = "curvature";
    this.end = Math.max(...about.runs.flatMap((run) => [...run.t.slice(-1), ...run.history.t.slice(-1)])) || 1;
    this.renderer = new THREE.WebGLRenderer({ canvas: $("canvas"), antialias: true });
    // A sheet without curvature is white.
    this.renderer.setClearColor(0xeef1f4);
    this.renderer.setScissorTest(true);
    this.renderer.toneMapping = THREE.NoToneMapping;
    this.redraw = () => { this.pending ??= requestAnimationFrame(() => { this.pending = null; this.draw(); }); };
    this.panels = surfaces.map((surface, i) => this._panel(surface, section(surface.about, i)));
    this.t = this.end;
    this._controls();
    this.goTo(this.end);
  }

  _panel(surface, element) {
    const panel = new Panel(surface, element, this.redraw);
    panel.chart = new Chart(element.querySelector(".chart"), surface.about, this.palette.energies, this.end, (t) => this.goTo(t));
    panel.status = element.querySelector(".status");
    panel.onpoint = () => this._describe(panel);
    return panel;
  }

  _describe(panel) {
    const { surface, marked } = panel;
    let text = panel.chart.describe(this.t);
    const [frame, share] = surface.place(this.t), last = surface.times.length - 1;
    const where = share > 0 && share < 1 ? `between frames ${frame} and ${frame + 1}` : `frame ${frame + Math.round(share)} of ${last}`;
    text = [this.t > surface.times[last] ? `ended, ${where}` : where, text].filter(Boolean).join(": ");
    const found = marked && surface.valueAt(this.field, marked.face, marked.weights);
    if (found) text += `; here ${found.beyond ? "beyond " : ""}${short(found.value)} (${surface.about.fields[this.field].label})`;
    panel.status.textContent = text;
  }

  _controls() {
    for (const [name, field] of [...Object.entries(this.panels[0].surface.about.fields), ["paper", { label: "none" }]]) {
      $("field").add(new Option(field.label, name, false, name === this.field));
    }
    Object.assign($("time"), { max: this.end, value: this.end });
    $("time").addEventListener("input", () => this.goTo(+$("time").value));
    $("field").addEventListener("change", () => { this.field = $("field").value === "paper" ? null : $("field").value; this.goTo(this.t); });
    $("walls").addEventListener("change", () => { for (const panel of this.panels) panel.walls.visible = $("walls").checked; this.redraw(); });
    $("fit").addEventListener("change", () => { for (const panel of this.panels) panel.fits = $("fit").checked; this.redraw(); });
    $("walls").parentElement.hidden = !this.panels.some((panel) => panel.walls.children.length);
    $("play").addEventListener("click", () => this.play(!this.playing));
    $("home").addEventListener("click", () => { for (const panel of this.panels) panel.home(); });
    addEventListener("keydown", (event) => this._key(event));
    addEventListener("resize", this.redraw);
    addEventListener("scroll", this.redraw, true);
  }

  _key(event) {
    // Keys that the focused control needs itself, and those that turn the sheet.
    const own = event.target.closest("select") || (" Enter".includes(event.key) && event.target.closest("button, input[type=checkbox]"));
    if (own || event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return;
    if (this._nudge(event)) return event.preventDefault();
    const frame = (event.key === "ArrowRight" || event.key === ".") - (event.key === "ArrowLeft" || event.key === ",");
    if (event.key === " ") this.play(!this.playing);
    else if (event.key.toLowerCase() === "r") $("home").click();
    else if (event.key === "Home") this.goTo(0);
    else if (event.key === "End") this.goTo(this.end);
    else if (frame) this.step(frame);
    else return;
    event.preventDefault();
  }

  // Move the mark of a crease pattern that has the focus, and let its value be read out.
  _nudge(event) {
    const panel = this.panels.find(({ flat }) => flat.element === event.target);
    if (!panel) return false;
    const right = (event.key === "ArrowRight") - (event.key === "ArrowLeft"), up = (event.key === "ArrowUp") - (event.key === "ArrowDown");
    if (!right && !up && event.key !== "Escape") return false;
    panel.status.setAttribute("aria-live", "polite");
    if (event.key === "Escape") panel.point(null);
    else panel.nudge(right, up);
    return true;
  }

  // Go to the next frame of any run, or to the one before.
  step(by) {
    const times = this.panels.flatMap((panel) => panel.surface.times).sort((a, b) => a - b), little = 1e-9 * this.end;
    const ahead = by > 0 ? times.find((t) => t > this.t + little) : times.findLast((t) => t < this.t - little);
    if (ahead !== undefined) this.goTo(ahead);
  }

  goTo(t) {
    this.t = Math.min(Math.max(t, 0), this.end);
    $("time").value = this.t;
    $("clock").textContent = `${this.t.toPrecision(4)} s`;
    $("time").setAttribute("aria-valuetext", `${this.t.toPrecision(4)} seconds`);
    this._scale();
    for (const panel of this.panels) {
      const table = this.field === null ? null : this._table(panel);
      panel.update(this.t, this.field, table);
      panel.chart.move(this.t);
      this._describe(panel);
    }
    this.redraw();
  }

  _table(panel) { return this.tables[panel.surface.about.fields[this.field].signed]; }

  // The colours and their range, which is the same for all runs.
  _scale() {
    $("scale").hidden = this.field === null;
    if (this.field === null || this.scaled === this.field) return;
    this.scaled = this.field;
    const { low, high, label, signed } = this.panels[0].surface.about.fields[this.field];
    const table = signed ? this.palette.signed : this.palette.plain;
    const context = $("colours").getContext("2d"), image = context.createImageData(256, 1);
    for (let k = 0; k < 256; k++) image.data.set([table[3 * k], table[3 * k + 1], table[3 * k + 2], 255], 4 * k);
    context.putImageData(image, 0, 0);
    $("low").textContent = short(low);
    $("high").textContent = short(high);
    $("scale").setAttribute("aria-label", `Colours from ${short(low)} to ${short(high)}: ${label}`);
  }

  play(on) {
    this.playing = on;
    for (const panel of this.panels) panel.status.setAttribute("aria-live", "off");
    $("play").textContent = on ? "Pause" : "Play";
    cancelAnimationFrame(this.advancing);
    if (!on) return;
    if (this.t >= this.end) this.goTo(0);
    let last = performance.now();
    const advance = (now) => {
      // All of a run in 12 seconds; the slider and the keys may move the clock meanwhile.
      this.goTo(this.t + (Math.max(now - last, 0) / 12e3) * this.end);
      last = now;
      if (this.t >= this.end) this.play(false);
      else this.advancing = requestAnimationFrame(advance);
    };
    this.advancing = requestAnimationFrame(advance);
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = $("canvas"), size = `${width} ${height} ${devicePixelRatio}`;
    if (size !== this.size) {
      this.size = size;
      this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      this.renderer.setSize(width, height, false);
    }
    this.renderer.setScissor(0, 0, width, height);
    this.renderer.clear();
    for (const panel of this.panels) panel.render(this.renderer, height);
    this.drawn = (this.drawn || 0) + 1;
  }
}

(async () => {
  try {
    const about = JSON.parse($("about").textContent);
    const blocks = await Promise.all([...document.querySelectorAll(".block")].map((block) => unpack(block.textContent)));
    const surfaces = about.runs.map((run, i) => new Surface(run, blocks[i]));
    $("runs").replaceChildren();
    window.page = new Page(about, surfaces);
  } catch (error) {
    tell(`The page cannot be shown (${error.message}). It needs WebGL 2 and a browser of 2023 or later.`);
    throw error;
  }
})();
