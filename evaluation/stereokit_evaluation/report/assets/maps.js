// Reads the maps that stereokit_evaluation.report.packing wrote, and turns them into pictures.
"use strict";

const Maps = (() => {
  function bytes(text) {
    const letters = atob(text);
    const out = new Uint8Array(letters.length);
    for (let i = 0; i < out.length; i++) out[i] = letters.charCodeAt(i);
    return out;
  }

  async function inflate(text, format = "deflate") {
    const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream(format));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Median edge detector, left to right and top to bottom; NaN where unknown.
  async function map(packed) {
    const { width, height, steps, low } = packed;
    const size = width * height;
    const planes = await inflate(packed.data);
    const stored = new Int32Array(size);
    const out = new Float32Array(size);
    for (let y = 0, i = 0; y < height; y++) {
      for (let x = 0; x < width; x++, i++) {
        const w = x ? stored[i - 1] : 0;
        const n = y ? stored[i - width] : 0;
        const c = x && y ? stored[i - width - 1] : 0;
        const least = w < n ? w : n;
        const most = w < n ? n : w;
        const guess = c >= most ? least : c <= least ? most : w + n - c;
        const folded = planes[i] | (planes[size + i] << 8);
        const value = (guess + ((folded >> 1) ^ -(folded & 1))) & 65535;
        stored[i] = value;
        out[i] = value ? low + (value - 1) / steps : NaN;
      }
    }
    return out;
  }

  async function mask(text, size) {
    const packed = await inflate(text);
    const out = new Uint8Array(size);
    for (let i = 0; i < size; i++) out[i] = (packed[i >> 3] >> (7 - (i & 7))) & 1;
    return out;
  }

  const canvas = (width, height) => Object.assign(document.createElement("canvas"), { width, height });

  function picture(width, height, paint) {
    const target = canvas(width, height);
    const context = target.getContext("2d");
    const image = context.createImageData(width, height);
    paint(new Uint32Array(image.data.buffer)); // pixels as 0xAABBGGRR
    context.putImageData(image, 0, 0);
    return target;
  }

  const word = ([r, g, b]) => (0xff000000 | (b << 16) | (g << 8) | r) >>> 0;

  function disparityPicture(values, width, height, bottom, top, turbo) {
    const colours = Uint32Array.from(turbo, word);
    return picture(width, height, (pixels) => {
      for (let i = 0; i < pixels.length; i++) {
        const v = values[i];
        const share = v <= bottom ? 0 : v >= top ? 1 : (v - bottom) / (top - bottom);
        pixels[i] = v !== v ? 0xff000000 : colours[Math.round(255 * share)];
      }
    });
  }

  // Every pixel with truth becomes a 3x3 square where truth is sparse, as in the benchmark's own pictures.
  function errorPicture(values, truth, seen, width, height, rule) {
    const colours = Uint32Array.from(rule.colours, word);
    const dimmed = Uint32Array.from(rule.colours, (c) => word(c.map((v) => v >> 1)));
    let known = 0;
    for (let i = 0; i < truth.length; i++) if (truth[i] === truth[i]) known++;
    const reach = known < 0.5 * truth.length ? 1 : 0;
    return picture(width, height, (pixels) => {
      pixels.fill(0xff000000);
      for (let y = 0, i = 0; y < height; y++) {
        for (let x = 0; x < width; x++, i++) {
          if (truth[i] !== truth[i]) continue;
          const error = Math.abs((values[i] === values[i] ? values[i] : -1) - truth[i]);
          const share = truth[i] > 0 ? error / (rule.share * truth[i]) : Infinity;
          const normal = Math.min(error / rule.pixels, share);
          let step = 0;
          while (step < rule.edges.length && normal >= rule.edges[step]) step++;
          const colour = (seen && !seen[i] ? dimmed : colours)[step];
          for (let v = Math.max(0, y - reach); v <= Math.min(height - 1, y + reach); v++)
            for (let u = Math.max(0, x - reach); u <= Math.min(width - 1, x + reach); u++) pixels[v * width + u] = colour;
        }
      }
    });
  }

  // Of two maps, or of their errors where there is truth: blue where A is smaller, or nearer to the truth, red where B is.
  function differencePicture(a, b, truth, width, height, rule) {
    const shade = Uint32Array.from(rule.colours, word);
    const middle = (shade.length - 1) / 2;
    let known = 0;
    if (truth) for (let i = 0; i < truth.length; i++) if (truth[i] === truth[i]) known++;
    const reach = truth && known < 0.5 * truth.length ? 1 : 0;
    return picture(width, height, (pixels) => {
      pixels.fill(0xff000000);
      for (let y = 0, i = 0; y < height; y++) {
        for (let x = 0; x < width; x++, i++) {
          const change = truth ? Math.abs(a[i] - truth[i]) - Math.abs(b[i] - truth[i]) : a[i] - b[i];
          if (change !== change) continue;
          const colour = shade[Math.round(middle * (1 + Math.max(-1, Math.min(1, change / rule.pixels))))];
          for (let v = Math.max(0, y - reach); v <= Math.min(height - 1, y + reach); v++)
            for (let u = Math.max(0, x - reach); u <= Math.min(width - 1, x + reach); u++) pixels[v * width + u] = colour;
        }
      }
    });
  }

  async function photograph(uri, width, height) {
    const image = new Image();
    image.src = uri;
    await image.decode();
    const target = canvas(width, height);
    target.getContext("2d", { willReadFrequently: true }).drawImage(image, 0, 0);
    return target;
  }

  return { inflate, map, mask, disparityPicture, errorPicture, differencePicture, photograph };
})();
