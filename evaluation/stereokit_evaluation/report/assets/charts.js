// Unpacks Plotly, draws the charts in the page's colours, and shows the region that is chosen.
"use strict";

document.addEventListener("DOMContentLoaded", async () => {
  const figures = JSON.parse(document.getElementById("charts").textContent);
  const source = await Maps.inflate(document.getElementById("plotly").textContent.trim(), "gzip");
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(source);
  document.head.append(script);

  const region = document.getElementById("region");
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

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

  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  function draw() {
    for (const [id, figure] of Object.entries(figures)) {
      const narrow = document.getElementById(id).clientWidth < 480;
      const [[key, variants]] = Object.entries(figure.variants);
      const data = figure.data.map((trace, k) => ({ ...trace, [key]: variants[region.value][k] }));
      // Too narrow for figures on the bars or names on the points: the tables have them.
      if (narrow) for (const trace of data) { delete trace.texttemplate; if (trace.mode) trace.mode = "markers"; }
      Plotly.react(id, data, layout(figure, narrow), config);
    }
    document.body.dataset.charts = String(Number(document.body.dataset.charts || 0) + 1);
  }
  region.addEventListener("change", draw);
  Page.onTheme(draw);
  draw();
});
