const ink = () => getComputedStyle(document.body).color;

// Plotly is gzipped on the page, which makes it 60 % smaller.
async function loadPlotly() {
  const packed = document.getElementById("plotly").textContent;
  const bytes = Uint8Array.from(atob(packed), (character) => character.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(plain).text();
  document.head.append(script);
}

function zoomButton(title, icon, factor) {
  const click = (view) => {
    const { eye } = view._fullLayout.scene._scene.getCamera();
    const closer = Object.fromEntries(Object.entries(eye).map(([axis, value]) => [axis, factor * value]));
    Plotly.relayout(view, { "scene.camera.eye": closer });
  };
  return { name: title, title, icon, click };
}

function draw(view) {
  const { data, layout } = JSON.parse(view.previousElementSibling.textContent);
  layout.font = { color: ink(), family: getComputedStyle(document.body).fontFamily, size: 13 };
  const zooms = [zoomButton("Closer", Plotly.Icons.zoom_plus, 0.8), zoomButton("Farther", Plotly.Icons.zoom_minus, 1.25)];
  Plotly.newPlot(view, data, layout, { displaylogo: false, displayModeBar: true, responsive: true, scrollZoom: true,
    modeBarButtons: [[...zooms, "tableRotation", "pan3d", "resetCameraDefault3d", "toImage"]] });
  // Plotly would take the wheel from the page.
  view.addEventListener("wheel", (event) => event.ctrlKey || event.stopPropagation(), { capture: true });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    Plotly.relayout(view, { "font.color": ink() }));
}

const views = document.querySelectorAll(".scene");
loadPlotly().then(() => views.forEach(draw)).catch(() => views.forEach((view) => {
  view.textContent = "This browser cannot show the 3-D view; one of 2023 or later can.";
}));
