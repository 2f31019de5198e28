// Where does A lose to B: the figures of every pair for two methods, sorted by their difference.
"use strict";

const Pairs = (() => {
  const get = (id) => document.getElementById(id);
  const figure = (value) => (value === null ? "–" : value.toFixed(2));

  function start() {
    const root = get("pairs");
    if (!root) return;
    const { frames, methods, measures, viewer } = JSON.parse(get("per-pair").textContent);
    const [a, b, measure] = [get("pairs-a"), get("pairs-b"), get("pairs-measure")];
    for (const select of [a, b]) select.replaceChildren(...methods.map((name) => new Option(name, name)));
    measure.replaceChildren(...Object.keys(measures).map((name) => new Option(name, name)));
    a.value = root.dataset.a;
    b.value = root.dataset.b;

    function look(frame) {
      const show = Viewer.show(viewer[frame], a.value, b.value);
      get("viewer").scrollIntoView();
      return show;
    }

    function draw() {
      const table = measures[measure.value];
      const [i, j] = [methods.indexOf(a.value), methods.indexOf(b.value)];
      const rows = frames.map((name, k) => {
        const [p, q] = [table[i][k], table[j][k]];
        return { name, p, q, difference: p === null || q === null ? null : p - q };
      });
      // The pairs on which A loses most come first; those without figures last.
      rows.sort((r, s) => (r.difference === null) - (s.difference === null) || s.difference - r.difference);
      get("pairs-head-a").textContent = a.value;
      get("pairs-head-b").textContent = b.value;
      root.querySelectorAll("th[aria-sort]").forEach((th) => th.removeAttribute("aria-sort"));
      get("pairs-difference").setAttribute("aria-sort", "descending");
      get("pairs-rows").replaceChildren(...rows.map(({ name, p, q, difference }) => {
        const row = document.createElement("tr");
        const cell = (text, kind = "") => Object.assign(document.createElement("td"), { textContent: text, className: kind });
        const sign = difference === null ? "–" : (difference > 0 ? "+" : "") + difference.toFixed(2);
        const first = cell("", "text");
        if (name in viewer) {
          const button = Object.assign(document.createElement("button"), { type: "button", textContent: name, className: "link" });
          button.addEventListener("click", () => look(name));
          first.append(button);
        } else first.textContent = name;
        row.append(first, cell(figure(p)), cell(figure(q)), cell(sign, difference > 0 ? "worse" : ""));
        return row;
      }));
      const known = rows.filter((row) => row.difference !== null);
      const count = (holds) => known.filter(holds).length;
      const mean = known.reduce((sum, row) => sum + row.difference, 0) / (known.length || 1);
      get("pairs-sum").textContent =
        `Of ${known.length} pairs ${a.value} is worse than ${b.value} on ${count((r) => r.difference > 0)}, better on ` +
        `${count((r) => r.difference < 0)}, equal on ${count((r) => r.difference === 0)}; mean difference ` +
        `${mean > 0 ? "+" : ""}${mean.toFixed(2)}.`;
    }

    for (const select of [a, b, measure]) select.addEventListener("change", draw);
    get("pairs-swap").addEventListener("click", () => {
      [a.value, b.value] = [b.value, a.value];
      draw();
    });
    draw();
  }

  return { start };
})();
