// The viewer: both images, disparity and error of two methods, with a slider between them or side by side, their
// difference, and numbers under the cursor.
"use strict";

// Parts of the report that lie in files beside the page: scripts, because a page from a disk may not fetch.
const Tiles = (() => {
  const waiting = new Map();

  function load(path) {
    return new Promise((give, fail) => {
      const script = document.createElement("script");
      waiting.set(path, give);
      script.src = path;
      script.onerror = () => fail(new Error(`${path} cannot be read: the page needs the folder beside it`));
      script.onload = () => script.remove(); // its content is with whoever asked, and nowhere else
      document.head.append(script);
    });
  }

  function put(path, content) {
    waiting.get(path)?.(content);
    waiting.delete(path);
  }

  return { load, put };
})();

const Viewer = (() => {
  const get = (id) => document.getElementById(id);
  const read = (id) => JSON.parse(get(id).textContent);
  const MOST = 6; // decoded maps that are kept
  const kept = []; // they themselves, the oldest first
  const text = (value, digits, unit) => (Number.isFinite(value) ? `${value.toFixed(digits)}${unit}` : "–");

  let started = null;
  const start = () => (started ??= begin());

  async function begin() {
    const root = get("viewer");
    const rules = read("constants");
    const canvases = {
      left: get("view-left"), right: get("view-right"), disparity: get("view-disparity"), disparityB: get("view-disparity-b"),
      error: get("view-error"), errorB: get("view-error-b"), difference: get("view-difference"),
    };
    const controls = {
      frame: get("frame"), a: get("method-a"), b: get("method-b"), slider: get("slider"), zoom: get("zoom"),
      layout: get("layout"), difference: get("difference"),
    };
    const side = () => controls.layout.value === "side" && state.a !== state.b;
    const cloud = new Cloud(get("view-cloud"));
    const state = { pair: null, a: null, b: null, x: 0, y: 0, cx: 0, cy: 0, cloud: false, load: 0 };
    const cache = new Map();

    // A canvas without pixels gives its memory back at once, and not when the garbage is collected.
    const free = (...pictures) => pictures.forEach((picture) => picture && (picture.width = 0));

    function keep(entry) {
      if (kept.includes(entry)) kept.splice(kept.indexOf(entry), 1);
      kept.push(entry);
      while (kept.length > MOST) {
        const old = kept.shift();
        free(old.decoded.disparity, old.decoded.error, old.decoded.differences?.picture);
        delete old.decoded;
      }
      return entry.decoded;
    }

    async function decoded(pair, index) {
      const entry = pair.maps[index];
      if (entry.decoded) return keep(entry);
      const { width, height } = pair;
      const packed = entry.tile ? await Tiles.load(entry.tile) : entry;
      const values = await Maps.map(packed.map);
      const measured = await Maps.mask(packed.measured, width * height);
      const error = pair.truthValues
        ? Maps.errorPicture(values, pair.truthValues, pair.seenValues, width, height, rules.error)
        : null;
      const disparity = Maps.disparityPicture(values, width, height, pair.bottom, pair.top, rules.turbo);
      entry.decoded = { name: entry.name, values, measured, disparity, error };
      return keep(entry);
    }

    function difference(pair, a, b) {
      const mode = pair.truthValues ? controls.difference.value : "disparity";
      const key = `${mode} ${a.name}`;
      if (b.differences?.key !== key) {
        const truth = mode === "error" ? pair.truthValues : null;
        b.differences = { key, picture: Maps.differencePicture(a.values, b.values, truth, pair.width, pair.height, rules.difference) };
      }
      return b.differences.picture;
    }

    async function pairAt(index) {
      if (cache.has(index)) {
        const pair = cache.get(index);
        cache.delete(index); // and to the end, as the newest
        cache.set(index, pair);
        return pair;
      }
      const tile = controls.frame.options[index].dataset.tile;
      const pair = tile ? await Tiles.load(tile) : read(`pair-${index}`);
      const size = pair.width * pair.height;
      pair.truthValues = pair.truth && (await Maps.map(pair.truth));
      pair.seenValues = pair.seen && (await Maps.mask(pair.seen, size));
      pair.picture = await Maps.photograph(pair.left, pair.width, pair.height);
      pair.rightPicture = pair.right && (await Maps.photograph(pair.right, pair.width, pair.height));
      if (cache.size > 1) {
        const [oldest, old] = cache.entries().next().value;
        cache.delete(oldest);
        for (const entry of old.maps) {
          if (!entry.decoded) continue;
          kept.splice(kept.indexOf(entry), 1);
          free(entry.decoded.disparity, entry.decoded.error, entry.decoded.differences?.picture);
          delete entry.decoded;
        }
        free(old.picture, old.rightPicture);
      }
      cache.set(index, pair);
      return pair;
    }

    function options(select, pair, wanted) {
      const before = wanted ?? select.value;
      select.replaceChildren(...pair.maps.map((m) => new Option(m.note ? `${m.name} (${m.note})` : m.name, m.name)));
      if (pair.maps.some((m) => m.name === before)) select.value = before;
    }

    // An error is told in the page: the console is not where people look.
    async function show(...what) {
      try {
        await load(...what);
        get("trouble").hidden = true;
      } catch (error) {
        get("trouble").hidden = false;
        get("trouble").textContent = error.message;
      }
    }

    async function load(fresh, first, second) {
      const ticket = ++state.load;
      const pair = await pairAt(Number(controls.frame.value));
      if (fresh) {
        options(controls.a, pair, first ?? (state.pair ? undefined : root.dataset.a));
        options(controls.b, pair, second ?? (state.pair ? undefined : root.dataset.b));
      }
      const place = (name) => Math.max(0, pair.maps.findIndex((m) => m.name === name));
      const a = await decoded(pair, place(controls.a.value));
      const b = await decoded(pair, place(controls.b.value));
      if (ticket !== state.load) return; // something else was chosen meanwhile
      if (state.pair !== pair) {
        Object.assign(state, { x: pair.width >> 1, y: pair.height >> 1, cx: pair.width / 2, cy: pair.height / 2 });
        for (const canvas of Object.values(canvases)) Object.assign(canvas, { width: pair.width, height: pair.height });
      }
      Object.assign(state, { pair, a, b });
      root.querySelector(".views").classList.toggle("blind", !pair.truthValues);
      root.querySelectorAll("[data-needs-truth]").forEach((e) => (e.hidden = !pair.truthValues));
      const two = a !== b;
      canvases.right.closest("figure").hidden = !pair.right;
      for (const name of ["disparityB", "errorB"]) canvases[name].closest("figure").hidden = !side() || (name === "errorB" && !pair.truthValues);
      canvases.difference.closest("figure").hidden = !two;
      controls.slider.closest("label").hidden = get("flip").hidden = !two || side();
      for (const e of root.querySelectorAll("[data-name]")) e.textContent = ({ a, b })[e.dataset.name].name;
      for (const e of root.querySelectorAll("[data-only]"))
        e.hidden = (e.dataset.only === "side") !== side() || ("two" in e.dataset && !two);
      const worse = pair.truthValues && controls.difference.value === "error";
      get("difference-low").textContent = worse ? "A nearer to the truth" : `A smaller, ${rules.difference.pixels} px`;
      get("difference-high").textContent = worse ? "B nearer" : `A larger, ${rules.difference.pixels} px`;
      get("pixels").textContent = pair.pixels ?? "";
      get("bottom").textContent = pair.bottom.toFixed(0);
      get("top").textContent = `${pair.top.toFixed(0)} px`;
      const step = [...controls.frame.options].findIndex((o) => o.selected);
      get("previous").disabled = step <= 0;
      get("next").disabled = step >= controls.frame.options.length - 1;
      draw();
      if (state.cloud) points();
      root.dataset.ready = String(Number(root.dataset.ready || 0) + 1);
    }

    function window_() {
      const { pair } = state;
      const zoom = Number(controls.zoom.value);
      const [w, h] = [pair.width / zoom, pair.height / zoom];
      const clamp = (v, most) => Math.max(0, Math.min(most, v));
      return [clamp(state.cx - w / 2, pair.width - w), clamp(state.cy - h / 2, pair.height - h), w, h, zoom];
    }

    function draw() {
      const { pair, a, b } = state;
      if (!pair) return;
      const [x0, y0, w, h, zoom] = window_();
      const sliding = a !== b && !side();
      const share = sliding ? Number(controls.slider.value) : 100;
      const cut = Math.round((pair.width * share) / 100);
      const both = (picture) => [picture, picture];
      const pictures = {
        left: both(pair.picture), right: both(pair.rightPicture),
        disparity: [a.disparity, b.disparity], disparityB: both(side() ? b.disparity : null),
        error: [a.error, b.error], errorB: both(side() ? b.error : null),
        difference: both(a === b ? null : difference(pair, a, b)),
      };
      const shift = a.values[state.y * pair.width + state.x]; // where the right image has the same point
      for (const [name, canvas] of Object.entries(canvases)) {
        const context = canvas.getContext("2d");
        context.imageSmoothingEnabled = false;
        const [first, second] = pictures[name];
        if (!first?.width || !second.width) continue; // not there, or already given back
        context.drawImage(second, x0, y0, w, h, 0, 0, pair.width, pair.height);
        if (cut > 0) context.drawImage(first, x0, y0, cut / zoom, h, 0, 0, cut, pair.height);
        const thin = Math.max(1, pair.width / canvas.clientWidth);
        if (sliding && (name === "disparity" || name === "error") && cut > 0 && cut < pair.width) {
          context.fillStyle = "#fff";
          context.fillRect(cut - thin, 0, 2 * thin, pair.height);
        }
        if (name === "right" && shift !== shift) continue;
        const column = name === "right" ? state.x - shift : state.x;
        const [px, py] = [(column + 0.5 - x0) * zoom, (state.y + 0.5 - y0) * zoom];
        for (const [colour, width] of [["#000", 3 * thin], ["#fff", thin]]) {
          context.strokeStyle = colour;
          context.lineWidth = width;
          context.beginPath();
          context.moveTo(px - 12 * thin, py); context.lineTo(px - 3 * thin, py);
          context.moveTo(px + 3 * thin, py); context.lineTo(px + 12 * thin, py);
          context.moveTo(px, py - 12 * thin); context.lineTo(px, py - 3 * thin);
          context.moveTo(px, py + 3 * thin); context.lineTo(px, py + 12 * thin);
          context.stroke();
        }
      }
      readout();
    }

    function depth(d) {
      const c = state.pair.calibration;
      return c && d + c.doffs > 0 ? (c.fx * c.baseline_m) / (d + c.doffs) : NaN;
    }

    function readout() {
      const { pair, x, y } = state;
      const i = y * pair.width + x;
      const truth = pair.truthValues ? pair.truthValues[i] : NaN;
      const hidden = pair.seenValues && Number.isFinite(truth) && !pair.seenValues[i] ? "occluded" : "";
      const row = (name, d, how) => {
        const e = how === null ? NaN : Math.abs(d - truth);
        const bad = e > rules.error.pixels && e / truth > rules.error.share;
        const error = how === null ? "" : text(e, 2, " px") + (bad ? " ✗" : "");
        const tr = document.createElement("tr");
        const th = Object.assign(document.createElement("th"), { scope: "row", textContent: name });
        const cells = [text(d, 2, " px"), text(depth(d), 2, " m"), ...(pair.truthValues ? [error] : []), how ?? hidden];
        tr.append(th, ...cells.map((c) => Object.assign(document.createElement("td"), { textContent: c })));
        return tr;
      };
      const how = (m) => (m.measured[i] ? "" : "filled");
      const rows = [row(state.a.name, state.a.values[i], how(state.a))];
      if (state.b !== state.a) rows.push(row(state.b.name, state.b.values[i], how(state.b)));
      if (pair.truthValues) rows.push(row("true", truth, null));
      get("position").textContent = `x ${x}, y ${y}`;
      get("values").replaceChildren(...rows);
    }

    function points() {
      const { pair, a } = state;
      if (!pair) return;
      const canvas = get("view-cloud");
      Object.assign(canvas, { width: Math.min(1242, pair.width), height: Math.round(Math.min(1242, pair.width) * 0.5) });
      const image = pair.picture.getContext("2d").getImageData(0, 0, pair.width, pair.height);
      cloud.set(a.values, a.measured, pair.width, pair.height, new Uint32Array(image.data.buffer), pair.calibration);
      get("cloud-unit").textContent = pair.calibration
        ? "metres, by the pair's calibration; measured points only, the farthest left out"
        : "no calibration: columns, rows and disparity, all in pixels; measured points only";
      canvas.dataset.points = String(cloud.count);
    }

    function move(x, y, follow) {
      const { pair } = state;
      if (!pair) return;
      state.x = Math.max(0, Math.min(pair.width - 1, x));
      state.y = Math.max(0, Math.min(pair.height - 1, y));
      if (follow) Object.assign(state, { cx: state.x, cy: state.y });
      draw();
    }

    for (const canvas of Object.values(canvases)) {
      const under = (e) => {
        const box = canvas.getBoundingClientRect();
        const [x0, y0, w, h] = window_();
        return [x0 + ((e.clientX - box.left) / box.width) * w, y0 + ((e.clientY - box.top) / box.height) * h];
      };
      canvas.addEventListener("pointermove", (e) => {
        if (!state.pair) return;
        const [x, y] = under(e);
        if (e.buttons && Number(controls.zoom.value) > 1 && e.pointerType === "mouse") {
          const [, , w] = window_();
          state.cx -= (e.movementX * w) / canvas.clientWidth;
          state.cy -= (e.movementY * w) / canvas.clientWidth;
        }
        move(Math.floor(x), Math.floor(y), false);
      });
      canvas.addEventListener("pointerdown", (e) => {
        if (!state.pair) return;
        if (narrow.matches) canvas.closest("figure").after(get("readout")); // below the picture, and over none
        move(...under(e).map(Math.floor), false);
      });
      canvas.addEventListener("dblclick", (e) => {
        if (!state.pair) return;
        const [x, y] = under(e);
        controls.zoom.value = Number(controls.zoom.value) < 8 ? String(2 * Number(controls.zoom.value)) : "1";
        move(Math.floor(x), Math.floor(y), true);
      });
      canvas.addEventListener("keydown", (e) => {
        const by = e.shiftKey ? 10 : 1;
        const moves = { ArrowLeft: [-by, 0], ArrowRight: [by, 0], ArrowUp: [0, -by], ArrowDown: [0, by] };
        if (!moves[e.key]) return;
        e.preventDefault();
        move(state.x + moves[e.key][0], state.y + moves[e.key][1], true);
      });
    }
    const home = document.createComment("read-out");
    get("readout").before(home);
    const narrow = matchMedia("(max-width: 999px)");
    narrow.addEventListener("change", () => home.after(get("readout")));
    controls.layout.addEventListener("change", () => show(false));
    controls.difference.addEventListener("change", () => show(false));
    controls.frame.addEventListener("change", () => show(true));
    controls.a.addEventListener("change", () => show(false));
    controls.b.addEventListener("change", () => show(false));
    controls.slider.addEventListener("input", draw);
    controls.zoom.addEventListener("change", () => move(state.x, state.y, true));
    const turn = (by) => () => {
      controls.frame.selectedIndex += by;
      show(true);
    };
    get("previous").addEventListener("click", turn(-1));
    get("next").addEventListener("click", turn(1));
    get("flip").addEventListener("click", () => {
      controls.slider.value = Number(controls.slider.value) > 50 ? "0" : "100";
      draw();
    });
    get("cloud-toggle").addEventListener("click", (e) => {
      state.cloud = !state.cloud;
      e.currentTarget.setAttribute("aria-pressed", String(state.cloud));
      get("cloud-figure").hidden = !state.cloud;
      if (state.cloud) points();
    });
    get("turbo").style.background = `linear-gradient(to right, ${rules.turbo.filter((_, k) => k % 15 === 0).map((c) => `rgb(${c})`).join(", ")})`;
    get("shades").style.background = `linear-gradient(to right, ${rules.difference.colours.map((c) => `rgb(${c})`).join(", ")})`;
    get("steps").replaceChildren(...rules.error.colours.map((c) => Object.assign(document.createElement("i"), { style: `background: rgb(${c})` })));
    if (root.dataset.cloud === "open") get("cloud-toggle").click();
    addEventListener("resize", draw);
    choose = (frame, a, b) => {
      controls.frame.selectedIndex = frame;
      return show(true, a, b);
    };
    await show(true);
  }

  let choose = null;
  async function show(frame, a, b) {
    await start();
    return choose(frame, a, b);
  }

  return { start, show, kept: () => kept.length };
})();
