"use strict";
// A run decoded from its block: positions at any time, normals that keep creases sharp, and values.

// Faces at a node whose normals enclose more than this angle are shaded as two smooth parts.
const CREASE = Math.cos((40 * Math.PI) / 180);
// Colour of a sheet without values, and largest number of a colour, which is linear light.
const PAPER = 54000, FULL = 65535;
const TYPES = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };

// Colours of a table from 0 to 255 (sRGB) as linear light.
function linear(table) {
  return Uint16Array.from(table, (level) => {
    const share = level / 255;
    return Math.round(FULL * (share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4));
  });
}

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

class Surface {
  constructor(about, buffer) {
    this.about = about;
    const array = (place) => new TYPES[place.type](buffer, place.start, place.count);
    this.nodes = about.nodes;
    this.times = about.t;
    this.faces = array(about.faces);
    this.rest = array(about.rest);
    this.hinges = array(about.hinges);
    this.creases = array(about.creases);
    this.x = array(about.x);
    // Frames after the first are stored as changes; the sum wraps as the difference did.
    for (let i = 3 * this.nodes; i < this.x.length; i++) this.x[i] += this.x[i - 3 * this.nodes];
    this.fields = {};
    for (const [name, field] of Object.entries(about.fields)) this.fields[name] = array(field.values);
    this.now = new Float32Array(3 * this.nodes);
    this.shades = new Float32Array(this.nodes);
    this.positions = new Float32Array(3 * this.faces.length);
    this.normals = new Float32Array(3 * this.faces.length);
    this.colours = new Uint16Array(3 * this.faces.length);
    this._flat = new Float32Array(this.faces.length);
    this._length = new Float32Array(this.faces.length / 3);
    this._listCorners();
    this._measure();
  }

  // Largest distance of a node from the middle of the run, frame by frame.
  _measure() {
    const { low, high, unit } = this.about, half = low.map((value, i) => (0.5 * (high[i] - value)) / unit);
    this.reach = this.times.map((_, frame) => {
      let most = 0;
      for (let i = 3 * this.nodes * frame; i < 3 * this.nodes * (frame + 1); i += 3) {
        const a = this.x[i] - half[0], b = this.x[i + 1] - half[1], c = this.x[i + 2] - half[2];
        most = Math.max(most, a * a + b * b + c * c);
      }
      return Math.max(unit * Math.sqrt(most), 1e-9);
    });
  }

  // Corners at each node, one node after the other.
  _listCorners() {
    this.first = new Uint32Array(this.nodes + 1);
    for (const node of this.faces) this.first[node + 1]++;
    for (let node = 0; node < this.nodes; node++) this.first[node + 1] += this.first[node];
    const next = this.first.slice(0, -1);
    this.corners = new Uint32Array(this.faces.length);
    this.faces.forEach((node, corner) => { this.corners[next[node]++] = corner; });
  }

  // Frame before time t, and the share of the way to the next one.
  place(t) {
    let frame = 0;
    while (frame < this.times.length - 2 && this.times[frame + 1] <= t) frame++;
    if (this.times.length === 1) return [0, 0];
    const span = this.times[frame + 1] - this.times[frame];
    return [frame, span > 0 ? Math.min(Math.max((t - this.times[frame]) / span, 0), 1) : 1];
  }

  // Move to time t, coloured by a field (null: plain); table: 256 colours.
  update(t, field, table) {
    const [frame, share] = this.place(t);
    const a = 3 * this.nodes * frame, b = share > 0 ? a + 3 * this.nodes : a;
    const { low, unit } = this.about;
    for (let i = 0; i < this.now.length; i++) {
      this.now[i] = low[i % 3] + unit * (this.x[a + i] + share * (this.x[b + i] - this.x[a + i]));
    }
    this.frame = share < 0.5 ? frame : Math.min(frame + 1, this.times.length - 1);
    this._place();
    this._shade();
    this._colour(field === null ? null : this.fields[field], frame, share, table);
  }

  _place() {
    const { faces, now, positions } = this;
    for (let corner = 0; corner < faces.length; corner++) {
      const node = 3 * faces[corner], to = 3 * corner;
      positions[to] = now[node];
      positions[to + 1] = now[node + 1];
      positions[to + 2] = now[node + 2];
    }
  }

  _shade() {
    const { faces, positions: p, _flat: flat, _length: length, first, corners, normals } = this;
    for (let f = 0; f < faces.length / 3; f++) {
      const o = 9 * f;
      const ux = p[o + 3] - p[o], uy = p[o + 4] - p[o + 1], uz = p[o + 5] - p[o + 2];
      const vx = p[o + 6] - p[o], vy = p[o + 7] - p[o + 1], vz = p[o + 8] - p[o + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      flat[3 * f] = nx;
      flat[3 * f + 1] = ny;
      flat[3 * f + 2] = nz;
      length[f] = Math.sqrt(nx * nx + ny * ny + nz * nz) || 1e-30;
    }
    for (let corner = 0; corner < faces.length; corner++) {
      const mine = Math.floor(corner / 3), node = faces[corner];
      const mx = flat[3 * mine], my = flat[3 * mine + 1], mz = flat[3 * mine + 2];
      let x = 0, y = 0, z = 0;
      for (let k = first[node]; k < first[node + 1]; k++) {
        const other = Math.floor(corners[k] / 3);
        const ox = flat[3 * other], oy = flat[3 * other + 1], oz = flat[3 * other + 2];
        // Weighted by the area of the face.
        if (mx * ox + my * oy + mz * oz >= CREASE * length[mine] * length[other]) { x += ox; y += oy; z += oz; }
      }
      const size = Math.sqrt(x * x + y * y + z * z) || 1;
      normals[3 * corner] = x / size;
      normals[3 * corner + 1] = y / size;
      normals[3 * corner + 2] = z / size;
    }
  }

  _colour(values, frame, share, table) {
    const { faces, colours, shades, nodes } = this;
    if (values === null) { colours.fill(PAPER); return; }
    const a = nodes * frame, b = share > 0 ? a + nodes : a;
    for (let node = 0; node < nodes; node++) shades[node] = values[a + node] + share * (values[b + node] - values[a + node]);
    for (let corner = 0; corner < faces.length; corner++) {
      const from = 3 * Math.round(shades[faces[corner]]);
      colours[3 * corner] = table[from];
      colours[3 * corner + 1] = table[from + 1];
      colours[3 * corner + 2] = table[from + 2];
    }
  }

  // Value of a field at the corner-weighted point of a face, or null.
  valueAt(field, face, weights) {
    if (field === null) return null;
    const { low, high, signed } = this.about.fields[field];
    let level = 0;
    for (let k = 0; k < 3; k++) level += weights[k] * this.shades[this.faces[3 * face + k]];
    return { value: low + ((high - low) * level) / 255, beyond: level > 254.5 || (signed && level < 0.5) };
  }

  // Points of the middle part of each hinge on the flat sheet, slightly above it; part: from 0 to 1.
  hingeLines(part) {
    const { hinges, rest } = this, points = new Float32Array(3 * hinges.length), mine = 0.5 * (1 + part), its = 0.5 * (1 - part);
    for (let end = 0; end < hinges.length; end++) {
      const node = 2 * hinges[end], other = 2 * hinges[end ^ 1];
      points.set([mine * rest[node] + its * rest[other], mine * rest[node + 1] + its * rest[other + 1], 1e-3], 3 * end);
    }
    return points;
  }

  // Indices of the `hingeLines` whose crease has this sign in the current frame.
  creased(sign, out) {
    const count = this.hinges.length / 2, from = count * this.frame;
    let length = 0;
    for (let hinge = 0; hinge < count; hinge++) {
      if (this.creases[from + hinge] === sign) {
        out[length++] = 2 * hinge;
        out[length++] = 2 * hinge + 1;
      }
    }
    return length;
  }
}
