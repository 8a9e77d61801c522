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

function zoom(view, factor) {
  const { eye } = view._fullLayout.scene._scene.getCamera();
  const moved = Object.fromEntries(Object.entries(eye).map(([axis, value]) => [axis, factor * value]));
  Plotly.relayout(view, { "scene.camera.eye": moved });
}

function zoomButton(title, icon, factor) {
  return { name: title, title, icon, click: (view) => zoom(view, factor) };
}

// The wheel scrolls the page, of which Plotly would keep it; with Ctrl it zooms.
function turnWheel(event) {
  event.stopPropagation();
  if (!event.ctrlKey) return;
  event.preventDefault();
  zoom(event.currentTarget, Math.exp(Math.max(-100, Math.min(100, event.deltaY)) / 500));
}

function draw(view) {
  const { data, layout } = JSON.parse(view.previousElementSibling.textContent);
  layout.font = { color: ink(), family: getComputedStyle(document.body).fontFamily, size: 13 };
  const zooms = [zoomButton("Closer", Plotly.Icons.zoom_plus, 0.8), zoomButton("Farther", Plotly.Icons.zoom_minus, 1.25)];
  Plotly.newPlot(view, data, layout, { displaylogo: false, displayModeBar: true, responsive: true, scrollZoom: false,
    modeBarButtons: [[...zooms, "tableRotation", "pan3d", "resetCameraDefault3d", "toImage"]] });
  view.addEventListener("wheel", turnWheel, { capture: true, passive: false });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    Plotly.relayout(view, { "font.color": ink() }));
}

const views = document.querySelectorAll(".scene");
loadPlotly().then(() => views.forEach(draw)).catch(() => views.forEach((view) => {
  view.textContent = "This browser cannot show the 3-D view; one of 2023 or later can.";
}));
