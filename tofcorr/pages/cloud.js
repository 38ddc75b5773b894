// Points in space to turn with a mouse, a finger or keys. A canvas names its data by `data-cloud`: an element of JSON with
// `clouds` (by name: base64 of float32 rows x, y, z in metres, then the error in millimetres), `wall` (corners, metres) and
// `limit` (error of the deepest colour, millimetres). Buttons with `data-show` name the cloud to show.
for (const canvas of document.querySelectorAll("canvas[data-cloud]")) {
  const data = JSON.parse(document.getElementById(canvas.dataset.cloud).textContent);
  const names = Object.keys(data.clouds), bins = 20, clouds = {};
  for (const name of names) {
    const bytes = Uint8Array.from(atob(data.clouds[name]), one => one.charCodeAt(0));
    clouds[name] = new Float32Array(bytes.buffer);
  }
  const middle = [0, 1, 2].map(k => data.wall.reduce((sum, corner) => sum + corner[k] / data.wall.length, 0));
  const size = Math.max(...data.wall.map(corner => Math.hypot(...corner.map((value, k) => value - middle[k]))));
  const buttons = [...canvas.closest("figure").querySelectorAll("button[data-show]")];
  const start = {across: -0.9, up: 0.35, zoom: 1.3};
  let view = {...start}, shown = names[0], held = null;
  // The signed colours of the package, purple to orange; no error is grey, which can be seen on light and dark pages.
  const ends = [[84, 39, 136], [150, 150, 150], [230, 97, 1]];
  const colour = bin => {
    const place = 2 * bin / (bins - 1), low = Math.min(Math.floor(place), 1), part = place - low;
    return `rgb(${ends[low].map((value, k) => value + part * (ends[low + 1][k] - value)).join(" ")})`;
  };
  const draw = () => {
    const style = getComputedStyle(canvas), pen = canvas.getContext("2d"), ratio = devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    pen.scale(ratio, ratio);
    const scale = view.zoom * Math.min(width, height) / 2 / size;
    const [sa, ca, su, cu] = [Math.sin(view.across), Math.cos(view.across), Math.sin(view.up), Math.cos(view.up)];
    const place = (x, y, z) => {
      const [a, b, c] = [x - middle[0], y - middle[1], z - middle[2]], away = c * ca - a * sa;
      return [width / 2 + scale * (a * ca + c * sa), height / 2 + scale * (b * cu + away * su)];
    };
    const points = clouds[shown], drawn = Array.from({length: bins}, () => []);
    for (let k = 0; k < points.length; k += 4) {
      const bin = Math.round((points[k + 3] / data.limit + 1) / 2 * (bins - 1));
      drawn[Math.min(Math.max(bin, 0), bins - 1)].push(place(points[k], points[k + 1], points[k + 2]));
    }
    drawn.forEach((own, bin) => { pen.fillStyle = colour(bin); for (const [x, y] of own) pen.fillRect(x - 1, y - 1, 2, 2); });
    pen.strokeStyle = style.color; pen.lineWidth = 1.5; pen.beginPath();
    data.wall.forEach((corner, k) => pen[k ? "lineTo" : "moveTo"](...place(...corner)));
    pen.closePath(); pen.stroke();
    buttons.forEach(one => one.setAttribute("aria-pressed", one.dataset.show === shown));
  };
  const turn = (across, up) => { view.across += across; view.up += up; draw(); };
  const show = name => { shown = name; draw(); };
  const zoom = factor => { view.zoom *= factor; draw(); };
  const keys = {
    ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, 0.1), ArrowDown: () => turn(0, -0.1),
    "+": () => zoom(1.15), "-": () => zoom(1 / 1.15), "0": () => { view = {...start}; draw(); },
    " ": () => show(names[(names.indexOf(shown) + 1) % names.length]),
  };
  canvas.onkeydown = event => { if (keys[event.key]) { event.preventDefault(); keys[event.key](); } };
  canvas.onpointerdown = event => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); };
  canvas.onpointermove = event => {
    if (!held) return;
    turn((event.clientX - held[0]) / 120, (event.clientY - held[1]) / 120);
    held = [event.clientX, event.clientY];
  };
  canvas.onpointerup = canvas.onpointercancel = () => { held = null; };
  buttons.forEach(one => { one.onclick = () => show(one.dataset.show); });
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").onchange = draw;
}
