"use strict";
// The two views of a run: the sheet in space, and its crease pattern on the flat sheet.

const LINE = 0x101418, MARK = 0x00a36c, WALL = 0x4a76a8;
// Part of a hinge that is drawn for each sign of a crease: mountains are whole lines, valleys dashed.
const DRAWN = [[1, 1], [-1, 0.5]];
// A wall around the sheet is shown whole if it extends at most this many times as far.
const AROUND = 1.6;
const UP = new THREE.Vector3(0, 0, 1), VIEW = new THREE.Vector3(-0.45, -0.8, 0.55).normalize();

function sheetMaterial() {
  const material = new THREE.MeshStandardMaterial({ vertexColors: true, side: THREE.DoubleSide, roughness: 0.9, metalness: 0 });
  // The back is darker and bluish.
  material.onBeforeCompile = (shader) => {
    shader.fragmentShader = shader.fragmentShader.replace(
      "#include <color_fragment>",
      "#include <color_fragment>\nif (!gl_FrontFacing) diffuseColor.rgb = 0.72 * mix(diffuseColor.rgb, vec3(0.42, 0.5, 0.62), 0.25);",
    );
  };
  return material;
}

function wallMaterial() {
  return new THREE.ShaderMaterial({
    transparent: true, depthWrite: false, side: THREE.DoubleSide,
    uniforms: { tint: { value: new THREE.Color(WALL) } },
    vertexShader: "varying vec3 n; void main() { n = normalMatrix * normal; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
    // The views are orthographic, so all rays are parallel.
    fragmentShader: "uniform vec3 tint; varying vec3 n; void main() { float f = 1.0 - abs(normalize(n).z); gl_FragColor = vec4(tint, 0.05 + 0.45 * f * f * f);\n#include <colorspace_fragment>\n }",
  });
}

// A wall as a mesh, and how it follows its number at a time.
function wallMesh(wall, size) {
  const material = wallMaterial(), at = (list) => new THREE.Vector3(...list);
  const center = at(wall.center || [0, 0, 0]), axis = at(wall.axis || wall.normal || [0, 0, 1]);
  let mesh;
  if (wall.kind === "Sphere" || wall.kind === "Ball") {
    mesh = new THREE.Mesh(new THREE.SphereGeometry(1, 64, 40), material);
    mesh.position.copy(center);
    mesh.follow = (value) => {
      mesh.scale.setScalar(wall.kind === "Sphere" ? value : wall.radius);
      if (wall.kind === "Ball") mesh.position.copy(center).addScaledVector(axis, value);
    };
    // Largest distance from a point.
    mesh.bound = (point) => mesh.position.distanceTo(point) + mesh.scale.x;
  } else if (wall.kind === "Cylinder") {
    mesh = new THREE.Mesh(new THREE.CylinderGeometry(1, 1, 1, 96, 1, true), material);
    mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), axis);
    mesh.position.copy(center);
    mesh.follow = (value) => mesh.scale.set(value, 1.3 * size, value);
  } else if (wall.kind === "Cone") {
    const length = 1.3 * size;
    mesh = new THREE.Mesh(new THREE.CylinderGeometry(Math.tan(wall.half_angle), 0, 1, 96, 1, true), material);
    mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), axis);
    mesh.scale.setScalar(length);
    mesh.follow = (value) => mesh.position.copy(center).addScaledVector(axis, value + 0.5 * length);
  } else if (wall.kind === "HoledPlate") {
    mesh = new THREE.Mesh(new THREE.RingGeometry(1, 1.001, 96), material);
    mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), axis);
    mesh.position.copy(center);
    mesh.follow = (value) => {
      if (mesh.value === value) return;
      mesh.value = value;
      mesh.geometry.dispose();
      mesh.geometry = new THREE.RingGeometry(value, Math.max(0.9 * size, 2 * value), 96);
    };
  } else {
    mesh = new THREE.Mesh(new THREE.CircleGeometry(0.7 * size, 96), material);
    mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), axis);
    mesh.follow = (value) => mesh.position.copy(axis).multiplyScalar(value);
  }
  mesh.moves = wall.moves;
  mesh.renderOrder = 1;
  return mesh;
}

class Panel {
  constructor(surface, element, redraw) {
    this.surface = surface;
    this.redraw = redraw;
    this.fits = true;
    const { low, high } = surface.about;
    this.middle = new THREE.Vector3(...low.map((value, i) => 0.5 * (value + high[i])));
    this.size = Math.hypot(...low.map((value, i) => high[i] - value));
    this.space = { element: element.querySelector(".space"), scene: new THREE.Scene() };
    this.flat = { element: element.querySelector(".pattern"), scene: new THREE.Scene() };
    this._addSheet();
    this._addPattern();
    this._addWalls();
    this._addMarkers();
    this._addCameras();
  }

  _geometry(positions) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", positions);
    geometry.setAttribute("color", this.colours);
    geometry.boundingSphere = { center: this.middle, radius: 1e3 };
    return geometry;
  }

  _addSheet() {
    const { surface } = this, dynamic = (array, normalized = false) =>
      new THREE.BufferAttribute(array, 3, normalized).setUsage(THREE.DynamicDrawUsage);
    this.positions = dynamic(surface.positions);
    this.normals = dynamic(surface.normals);
    this.colours = dynamic(surface.colours, true);
    const geometry = this._geometry(this.positions);
    geometry.setAttribute("normal", this.normals);
    this.space.mesh = new THREE.Mesh(geometry, sheetMaterial());
    this.space.mesh.frustumCulled = false;
    this.space.scene.add(this.space.mesh, new THREE.HemisphereLight(0xffffff, 0x9aa4b0, 1.9));
    this.lamp = new THREE.DirectionalLight(0xffffff, 1.9);
    this.space.scene.add(this.lamp, this.lamp.target);
  }

  _addPattern() {
    const { surface } = this, { faces, rest } = surface;
    const corners = new Float32Array(3 * faces.length);
    faces.forEach((node, corner) => { corners[3 * corner] = rest[2 * node]; corners[3 * corner + 1] = rest[2 * node + 1]; });
    const material = new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.DoubleSide });
    this.flat.mesh = new THREE.Mesh(this._geometry(new THREE.BufferAttribute(corners, 3)), material);
    this.flat.scene.add(this.flat.mesh);
    this.lines = DRAWN.map(([sign, part]) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(surface.hingeLines(part), 3));
      geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(Math.max(surface.hinges.length, 2)), 1).setUsage(THREE.DynamicDrawUsage));
      const lines = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: LINE }));
      lines.frustumCulled = false;
      lines.sign = sign;
      this.flat.scene.add(lines);
      return lines;
    });
    const xs = rest.filter((_, i) => i % 2 === 0), ys = rest.filter((_, i) => i % 2 === 1);
    const range = (values) => values.reduce(([a, b], value) => [Math.min(a, value), Math.max(b, value)], [Infinity, -Infinity]);
    this.extent = [range(xs), range(ys)];
  }

  _addWalls() {
    this.walls = new THREE.Group();
    for (const wall of this.surface.about.walls) this.walls.add(wallMesh(wall, this.size));
    this.space.scene.add(this.walls);
  }

  _addMarkers() {
    for (const view of [this.space, this.flat]) {
      // Faint where layers hide it.
      const ball = new THREE.SphereGeometry(1, 16, 12), look = { color: MARK, transparent: true };
      view.marker = new THREE.Mesh(ball, new THREE.MeshBasicMaterial(look));
      view.marker.add(new THREE.Mesh(ball, new THREE.MeshBasicMaterial({ ...look, depthTest: false, opacity: 0.35 })));
      view.marker.renderOrder = 2;
      view.marker.visible = false;
      view.scene.add(view.marker);
      view.element.addEventListener("pointermove", (event) => this._hover(view, event));
      view.element.addEventListener("pointerleave", () => this.point(null));
    }
  }

  _addCameras() {
    this.space.camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -3 * this.size, 9 * this.size);
    this.space.camera.up.copy(UP);
    this.controls = new THREE.OrbitControls(this.space.camera, this.space.element);
    this.controls.addEventListener("change", this.redraw);
    // Shift and arrow keys turn; arrow keys alone step through the frames.
    this.controls.listenToKeyEvents(this.space.element);
    this.controls.keyPanSpeed = 0;
    this.flat.camera = new THREE.OrthographicCamera(-1, 1, 1, -1, -100, 100);
    this.flat.camera.position.set(0, 0, 1);
    const [[left, right], [low, high]] = this.extent;
    this.flat.middle = [0.5 * (left + right), 0.5 * (low + high)];
    this.flat.half = 0.54 * Math.max(right - left, high - low);
    this.home();
  }

  home() {
    const { camera } = this.space;
    camera.position.copy(this.middle).addScaledVector(VIEW, 3 * this.size);
    camera.zoom = 1;
    this.controls.target.copy(this.middle);
    this.controls.update();
    this.redraw();
  }

  update(t, field, table) {
    const { surface } = this, [frame, share] = surface.place(t);
    surface.update(t, field, table);
    for (const attribute of [this.positions, this.normals, this.colours]) attribute.needsUpdate = true;
    for (const lines of this.lines) {
      const index = lines.geometry.index;
      lines.geometry.setDrawRange(0, surface.creased(lines.sign, index.array));
      index.needsUpdate = true;
    }
    for (const wall of this.walls.children) {
      const next = Math.min(frame + 1, wall.moves.length - 1);
      wall.follow(wall.moves[frame] + share * (wall.moves[next] - wall.moves[frame]));
    }
    const reach = surface.reach, next = Math.min(frame + 1, reach.length - 1);
    this.reach = reach[frame] + share * (reach[next] - reach[frame]);
    this.around = Math.max(this.reach, ...this.walls.children.map((wall) => (wall.bound ? wall.bound(this.middle) : 0)).filter((far) => far < AROUND * this.reach));
    if (this.marked) this.point(this.marked);
  }

  // Draw both views where their elements are.
  render(renderer, height) {
    for (const view of [this.space, this.flat]) {
      const box = view.element.getBoundingClientRect();
      if (box.bottom < 0 || box.top > height || box.width < 2 || box.height < 2) continue;
      const { camera } = view;
      this._frame(view, box.width / box.height);
      if (view === this.space) this._light(camera);
      renderer.setViewport(box.left, height - box.bottom, box.width, box.height);
      renderer.setScissor(box.left, height - box.bottom, box.width, box.height);
      renderer.render(view.scene, camera);
      this._bar(view, (camera.right - camera.left) / camera.zoom / box.width);
    }
  }

  // Set the extent of a view of this ratio of width to height.
  _frame(view, ratio) {
    const { camera } = view;
    const half = view === this.flat ? view.half : this.fits ? 1.08 * (this.walls.visible ? this.around : this.reach) : 1.08 * Math.max(...this.surface.reach);
    const [x, y] = view === this.space ? [0, 0] : view.middle;
    camera.left = x - half * Math.max(ratio, 1);
    camera.right = x + half * Math.max(ratio, 1);
    camera.top = y + half * Math.max(1 / ratio, 1);
    camera.bottom = y - half * Math.max(1 / ratio, 1);
    camera.updateProjectionMatrix();
    view.marker.scale.setScalar((0.016 * half) / camera.zoom);
  }

  _light(camera) {
    const side = new THREE.Vector3(-0.5, 0.65, 0.75).applyQuaternion(camera.quaternion);
    this.lamp.position.copy(this.middle).addScaledVector(side, this.size);
    this.lamp.target.position.copy(this.middle);
  }

  // A bar of a round length, of at most 90 pixels; `metres` per pixel.
  _bar(view, metres) {
    const longest = 90 * metres, power = 10 ** Math.floor(Math.log10(longest));
    const length = Math.max(...[1, 2, 5].map((n) => n * power).filter((value) => value <= longest));
    const bar = view.element.querySelector(".bar");
    bar.style.width = `${length / metres}px`;
    bar.textContent = length >= 0.01 ? `${+(100 * length).toPrecision(2)} cm` : `${+(1000 * length).toPrecision(2)} mm`;
  }

  _hover(view, event) {
    if (event.buttons) return;
    const box = view.element.getBoundingClientRect();
    this._pick(view, new THREE.Vector2((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height));
  }

  // Mark the point of the sheet at a place of a view, from -1 to 1 across and up.
  _pick(view, place) {
    const ray = new THREE.Raycaster();
    ray.setFromCamera(place, view.camera);
    const [hit] = ray.intersectObject(view.mesh);
    this.point(hit ? { face: hit.faceIndex, weights: hit.barycoord ? hit.barycoord.toArray() : [1 / 3, 1 / 3, 1 / 3] } : null);
  }

  // Move the mark on the flat sheet by steps of a fortieth of its width, from its middle on.
  nudge(right, up) {
    const { camera, marker, half, middle } = this.flat, before = this.marked, by = half / 20;
    const [x, y] = before ? [marker.position.x + right * by, marker.position.y + up * by] : middle;
    this._pick(this.flat, new THREE.Vector2((2 * (x - camera.left)) / (camera.right - camera.left) - 1, (2 * (y - camera.bottom)) / (camera.top - camera.bottom) - 1));
    // Not beyond the edge.
    if (!this.marked) this.point(before);
  }

  // Mark a point of the sheet in both views; null: none.
  point(marked) {
    this.marked = marked;
    for (const view of [this.space, this.flat]) {
      view.marker.visible = marked !== null;
      if (marked === null) continue;
      const corners = view.mesh.geometry.getAttribute("position");
      view.marker.position.set(0, 0, view === this.flat ? 0.01 : 0);
      marked.weights.forEach((weight, k) => {
        const corner = 3 * marked.face + k;
        view.marker.position.x += weight * corners.getX(corner);
        view.marker.position.y += weight * corners.getY(corner);
        if (view === this.space) view.marker.position.z += weight * corners.getZ(corner);
      });
    }
    if (this.onpoint) this.onpoint(marked);
    this.redraw();
  }
}
