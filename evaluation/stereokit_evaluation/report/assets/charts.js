// Unpacks Plotly, draws the charts in the page's colours, shows the region that is chosen, and keeps labels apart.
"use strict";

// Places for labels beside points, greedily: the nearest free one, so that no label meets another or a point.
// points: {x, y, width, height} of the marker's centre and the label, pixels; returns {dx, dy} of the label's centre.
const Labels = {
  place(points, [width, height], radius = 8) {
    const boxes = points.map(({ x, y }) => [x - radius, y - radius, x + radius, y + radius]);
    const meets = (p, q) => p[0] < q[2] && q[0] < p[2] && p[1] < q[3] && q[1] < p[3];
    return points.map(({ x, y, width: w, height: h }) => {
      let best = null;
      for (const distance of [0, 8, 18, 30, 44, 60, 80, 104]) {
        for (const [ux, uy] of [[0, -1], [1, 0], [-1, 0], [0, 1], [1, -1], [-1, -1], [1, 1], [-1, 1]]) {
          const dx = ux * (radius + 2 + distance + w / 2), dy = uy * (radius + 1 + distance + h / 2);
          const box = [x + dx - w / 2, y + dy - h / 2, x + dx + w / 2, y + dy + h / 2];
          if (box[0] < 0 || box[1] < 0 || box[2] > width || box[3] > height) continue;
          if (boxes.some((other) => meets(box, other))) continue;
          best = { dx, dy, far: distance > 0, box };
          break;
        }
        if (best) break;
      }
      if (best) boxes.push(best.box);
      return best; // none: so crowded that the tables tell more
    });
  },
};

document.addEventListener("DOMContentLoaded", async () => {
  const figures = JSON.parse(document.getElementById("charts").textContent);
  const source = await Maps.inflate(document.getElementById("plotly").textContent.trim(), "gzip");
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(source);
  document.head.append(script);
  script.remove(); // some megabytes of text
  document.getElementById("plotly").remove();

  const region = document.getElementById("region");
  const fault = document.getElementById("fault-figure"); // what the lines of disturbances show
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const measure = document.createElement("canvas").getContext("2d");

  function layout(figure, narrow) {
    const axis = { gridcolor: colour("--line"), zerolinecolor: colour("--line"), automargin: true };
    const given = figure.layout;
    return {
      ...given,
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: colour("--ink"), family: getComputedStyle(document.body).fontFamily, size: narrow ? 11 : 13 },
      margin: { l: 50, r: 16, t: 16, b: 40 },
      xaxis: { ...axis, ...given.xaxis }, yaxis: { ...axis, ...given.yaxis },
      legend: { ...given.legend, font: { size: narrow ? 10 : 12 } },
      hoverlabel: { bgcolor: colour("--paper"), font: { color: colour("--ink") } },
    };
  }

  // The texts of points as annotations, kept apart; a line leads to those that had to move away.
  function annotations(chart, traces, size) {
    const { xaxis, yaxis } = chart._fullLayout;
    measure.font = `${size}px ${getComputedStyle(document.body).fontFamily}`;
    const points = [];
    traces.forEach((trace, k) => {
      if (chart._fullData[k].visible !== true) return; // hidden by the legend
      (trace.text ?? []).forEach((text, i) => {
        if (!text || trace.x[i] === null || trace.y[i] === null) return;
        const at = { x: xaxis.d2p(trace.x[i]), y: yaxis.d2p(trace.y[i]) };
        points.push({ ...at, text, width: measure.measureText(text).width + 4, height: size + 4, value: [trace.x[i], trace.y[i]] });
      });
    });
    const places = Labels.place(points, [xaxis._length, yaxis._length]);
    const log = (axis, value) => (axis.type === "log" ? Math.log10(value) : value);
    return points.flatMap(({ text, value }, i) => places[i] ? [{
      x: log(xaxis, value[0]), y: log(yaxis, value[1]), text, ax: places[i].dx, ay: places[i].dy,
      showarrow: true, arrowhead: 0, arrowwidth: 0.8, standoff: 5,
      arrowcolor: places[i].far ? colour("--soft") : "rgba(0,0,0,0)",
      font: { size, color: colour("--ink") }, borderpad: 0,
    }] : []);
  }

  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  async function draw() {
    for (const [id, figure] of Object.entries(figures)) {
      const element = document.getElementById(id);
      if (!element) continue;
      if (figure.height) element.style.height = `${figure.height}px`;
      const narrow = element.clientWidth < 480;
      const [key, variants] = Object.entries(figure.variants ?? {})[0] ?? [];
      const choice = key && (region.value in variants ? region : fault);
      const data = figure.data.map((trace, k) => (key ? { ...trace, [key]: variants[choice.value][k] } : { ...trace }));
      const texts = data.map((trace) => trace.mode?.includes("text") ? trace : { ...trace, text: null });
      const bare = data.map((trace) => trace.mode ? { ...trace, mode: trace.mode.replace("+text", "") } : trace);
      const drawn = layout(figure, narrow);
      if (choice === fault && fault) drawn.yaxis.title = { text: fault.selectedOptions[0].textContent };
      await Plotly.react(id, bare, drawn, config);
      if (texts.some((trace) => trace.text)) {
        const label = () => Plotly.relayout(element, { annotations: annotations(element, texts, narrow ? 10 : 12) });
        await label();
        element.removeAllListeners("plotly_restyle");
        element.on("plotly_restyle", label);
      }
    }
    document.body.dataset.charts = String(Number(document.body.dataset.charts || 0) + 1);
  }
  let waiting = 0;
  addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(draw, 200);
  });
  region?.addEventListener("change", draw);
  fault?.addEventListener("change", draw);
  Page.onTheme(draw);
  await draw();
});
