// Points of a pair, drawn in software with a depth buffer: no WebGL, so that it works everywhere.
"use strict";

class Cloud {
  // With a calibration x, y, z are metres; without one columns, rows and minus the disparity, in pixels.
  constructor(canvas) {
    this.canvas = canvas;
    this.reset();
    this.count = 0;
    let from = null;
    canvas.addEventListener("pointerdown", (e) => {
      from = [e.clientX, e.clientY];
      canvas.setPointerCapture(e.pointerId);
    });
    canvas.addEventListener("pointermove", (e) => {
      if (!from) return;
      this.turn((e.clientX - from[0]) / 200, (e.clientY - from[1]) / 200);
      from = [e.clientX, e.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (from = null));
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(e.deltaY < 0 ? 1.1 : 1 / 1.1);
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const turns = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, -0.05], ArrowDown: [0, 0.05] };
      if (turns[e.key]) this.turn(...turns[e.key]);
      else if (e.key === "+" || e.key === "=") this.zoom(1.1);
      else if (e.key === "-") this.zoom(1 / 1.1);
      else if (e.key === "0") { this.reset(); this.draw(); }
      else return;
      e.preventDefault();
    });
  }

  reset() {
    this.yaw = 0.15;
    this.pitch = -0.22; // from above: the ground is in view
    this.near = 1;
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-1.4, Math.min(1.4, this.pitch + pitch));
    this.draw();
  }

  zoom(factor) {
    this.near = Math.max(0.2, Math.min(20, this.near * factor));
    this.draw();
  }

  // values: disparity; measured: which of them were not filled; colours: the left picture's pixels.
  set(values, measured, width, height, colours, camera) {
    const points = new Float32Array(3 * values.length);
    const paint = new Uint32Array(values.length);
    const depths = [];
    let n = 0;
    for (let y = 0, i = 0; y < height; y++) {
      for (let x = 0; x < width; x++, i++) {
        const d = values[i];
        if (d !== d || !measured[i]) continue; // what was filled is a guess, and the sky's is a bad one
        let p;
        if (camera) {
          const parallax = d + camera.doffs;
          if (!(parallax > 0)) continue;
          const z = (camera.fx * camera.baseline_m) / parallax;
          p = [(z * (x - camera.cx0)) / camera.fx, (z * (y - camera.cy)) / camera.fy, z];
        } else p = [x - width / 2, y - height / 2, -d * 4];
        points.set(p, 3 * n);
        paint[n++] = colours[i];
        if (n % 97 === 0) depths.push(p[2]);
      }
    }
    depths.sort((a, b) => a - b);
    const at = (share) => depths[Math.floor(share * (depths.length - 1))] ?? 1;
    this.metric = Boolean(camera);
    this.middle = at(0.5);
    // Far points are few columns of the image and most of the space: what lies beyond is left out.
    this.far = camera ? 3 * at(0.75) : Infinity;
    this.focal = camera ? camera.fx / width : 1;
    this.span = width;
    [this.points, this.paint, this.count] = [points, paint, n];
    this.draw();
  }

  draw() {
    const { canvas, points, paint } = this;
    if (!this.count) return;
    const [w, h] = [canvas.width, canvas.height];
    const context = canvas.getContext("2d");
    const image = context.createImageData(w, h);
    const pixels = new Uint32Array(image.data.buffer).fill(0xff181410);
    const depth = new Float32Array(w * h).fill(Infinity);
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const focal = this.focal * w * this.near;
    // From behind the cameras, so that the ground before them is in view too.
    const away = this.metric ? 1.6 * this.middle : 1.1 * this.span * this.focal;
    for (let i = 0; i < this.count; i++) {
      const z0 = points[3 * i + 2];
      if (z0 > this.far) continue;
      const x = points[3 * i], y = points[3 * i + 1], z = z0 - this.middle;
      const u = cy * x - sy * z, forward = sy * x + cy * z;
      const v = cp * y + sp * forward;
      const q = cp * forward - sp * y + away;
      if (q <= 0.02 * away) continue;
      const px = Math.round(w / 2 + (focal * u) / q), py = Math.round(h / 2 + (focal * v) / q);
      if (px < 0 || py < 0 || px >= w - 1 || py >= h - 1) continue;
      for (const at of [py * w + px, py * w + px + 1, (py + 1) * w + px, (py + 1) * w + px + 1])
        if (q < depth[at]) { depth[at] = q; pixels[at] = paint[i]; }
    }
    context.putImageData(image, 0, 0);
  }
}
