const ink = () => getComputedStyle(document.body).color;
for (const view of document.querySelectorAll(".scene")) {
  const { data, layout } = JSON.parse(view.previousElementSibling.textContent);
  layout.font = { color: ink(), family: getComputedStyle(document.body).fontFamily, size: 13 };
  Plotly.newPlot(view, data, layout, { displaylogo: false, displayModeBar: true, responsive: true, scrollZoom: false,
    modeBarButtons: [["tableRotation", "pan3d", "zoom3d", "resetCameraDefault3d", "toImage"]] });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    Plotly.relayout(view, { "font.color": ink() }));
}
