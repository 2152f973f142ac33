// The charts, drawn by Plotly as soon as the page has been painted.

const figures = readJson("chart-data");
const NARROW_PX = 600;
const PRINTED_PX = 680;
const LEGEND_ROW_PX = 22;

const inTwoLines = (title) => title.replace(/ (?=\()|(?<=,) /, "<br>");

// A figure with the colours and the width of its place.
const fitted = (figure, place, width) => {
  const isNarrow = width < NARROW_PX;
  const { color } = getComputedStyle(place);
  const line = getComputedStyle(place).borderTopColor;
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, automargin: true, fixedrange: true };
  const named = figure.data.filter((trace) => trace.showlegend !== false).length;
  const legendRows = named > 1 ? Math.ceil(named / (isNarrow ? 1 : 3)) : 0;
  const { xaxis, yaxis, height, ...layout } = figure.layout;
  const ticks = yaxis.ticktext && isNarrow ? { ticktext: yaxis.ticktext.map(inTwoLines) } : {};
  return {
    ...layout,
    width,
    height: height + legendRows * LEGEND_ROW_PX,
    margin: { l: 10, r: 10, t: 10, b: 60 + legendRows * LEGEND_ROW_PX },
    font: { color, size: isNarrow ? 11 : 13, family: "system-ui, sans-serif" },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    hovermode: "closest",
    showlegend: named > 1,
    legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom", x: 0 },
    xaxis: { ...axis, ...xaxis },
    yaxis: { ...axis, ...yaxis, ...ticks },
  };
};

const drawCharts = (width) => {
  for (const place of document.querySelectorAll(".chart")) {
    const figure = figures[place.dataset.chart];
    const layout = fitted(figure, place, width ?? place.clientWidth);
    Plotly.react(place, figure.data, layout, { displayModeBar: false });
  }
};

const listenToCharts = () => {
  let drawn = innerWidth;
  themeListeners.push(() => drawCharts());
  addEventListener("resize", () => {
    if (innerWidth !== drawn) drawCharts();
    drawn = innerWidth;
  });
  addEventListener("beforeprint", () => drawCharts(PRINTED_PX));
  addEventListener("afterprint", () => drawCharts());
};

if (byId("plotly")) {
  await new Promise((painted) => requestAnimationFrame(() => setTimeout(painted)));
  document.body.append(make("script", {}, await unpack("plotly")));
  drawCharts();
  listenToCharts();
  performance.mark("charts-drawn");
}
