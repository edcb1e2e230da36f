"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const [width, height] = data.size;
// The canvas drawer shows tiles that a browser loads from the disk, where WebGL refuses them.
const viewer = OpenSeadragon({
  element: document.getElementById("view"), tileSources: data.tiles, drawer: "canvas", showNavigationControl: false,
  gestureSettingsMouse: { clickToZoom: false }, gestureSettingsTouch: { clickToZoom: false, pinchRotate: true },
  maxZoomPixelRatio: 4, showNavigator: true, navigatorPosition: "BOTTOM_RIGHT", navigatorRotate: true,
});
const make = (name, parent, attributes) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return parent.appendChild(node);
};
const svg = make("svg", document.body, {});
const drawing = make("g", svg, {});
const seams = make("g", drawing, {});
if (data.seams) make("image", seams, { href: data.seams, x: data.seamsBox[0], y: data.seamsBox[1],
  width: data.seamsBox[2], height: data.seamsBox[3], preserveAspectRatio: "none" });
make("rect", make("clipPath", drawing, { id: "mosaic" }), { width, height });
const outlines = make("g", drawing, { "clip-path": "url(#mosaic)" });
const names = document.getElementById("names");
const images = data.images.map((image) => ({
  ...image,
  // An image across the edge of a full turn has two places; its name is at the one that shows more of it.
  path: make("path", outlines, { d: image.outlines.map((line) => "M" + line.join("L") + "Z").join("") }),
  center: image.centers.reduce((a, b) => (Math.abs(a[0] - width / 2) < Math.abs(b[0] - width / 2) ? a : b)),
  label: names.appendChild(Object.assign(document.createElement("span"), { textContent: image.name })),
}));

// The longest of 1, 2, 5, 10, … units that takes no more than so many pixels of the page.
const barLength = (unit, most) => {
  const power = 10 ** Math.floor(Math.log10(most / unit));
  return power * [5, 2, 1].find((step) => step * power * unit <= most);
};
const bar = document.getElementById("bar");
const showScale = (scale) => {
  const unit = scale / (data.metres || 1), length = barLength(unit, 150);
  bar.style.width = `${length * unit}px`;
  const [size, name] = !data.metres ? [length, "pixels"] : length >= 1000 ? [length / 1000, "km"]
    : length >= 1 ? [length, "m"] : [length * 100, "cm"];
  bar.textContent = `${Number(size.toPrecision(3))} ${name}`;
};
// Pixels of the mosaic to pixels of the page: one unit of the viewport is the width of the mosaic.
const place = () => {
  const at = (x, y) => viewer.viewport.pixelFromPoint(new OpenSeadragon.Point(x / width, y / width), true);
  const origin = at(0, 0), across = at(width, 0);
  // Along the first row of the mosaic, which may be turned.
  const a = (across.x - origin.x) / width, b = (across.y - origin.y) / width;
  drawing.setAttribute("transform", `matrix(${a},${b},${-b},${a},${origin.x},${origin.y})`);
  showScale(Math.hypot(a, b));
  const taken = [];
  for (const { label, center } of images) {
    const x = origin.x + a * center[0] - b * center[1], y = origin.y + b * center[0] + a * center[1];
    label.style.left = `${x}px`; label.style.top = `${y}px`;
    const half = label.textContent.length * 3.6 + 6;
    const free = taken.every(([a, b, c]) => Math.abs(a - x) > half + c || Math.abs(b - y) > 18);
    label.style.visibility = free ? "visible" : "hidden";
    if (free) taken.push([x, y, half]);
  }
};
viewer.addHandler("open", place);
viewer.addHandler("update-viewport", place);
viewer.addHandler("resize", place);

const inside = ([x, y], outline) => outline.reduce((odd, [x1, y1], k) => {
  const [x2, y2] = outline[(k + 1) % outline.length];
  return (y1 > y) !== (y2 > y) && x < ((x2 - x1) * (y - y1)) / (y2 - y1) + x1 ? !odd : odd;
}, false);
const facts = document.getElementById("facts");
const show = (chosen) => {
  for (const image of images) image.path.classList.toggle("chosen", image === chosen);
  facts.replaceChildren();
  if (!chosen) return;
  facts.appendChild(Object.assign(document.createElement("h2"), { textContent: chosen.name }));
  const table = facts.appendChild(document.createElement("table"));
  for (const [key, value] of chosen.facts) {
    const row = table.insertRow();
    row.insertCell().textContent = key;
    row.insertCell().textContent = value;
  }
};
viewer.addHandler("canvas-click", (event) => {
  if (!event.quick) return;
  const point = viewer.viewport.pointFromPixel(event.position);
  const at = [point.x * width, point.y * width];
  const distance = ({ centers }) => Math.min(...centers.map(([x, y]) => Math.hypot(x - at[0], y - at[1])));
  // Of several images that show a place, the one whose centre is nearest.
  show(images.filter((p) => p.outlines.some((line) => inside(at, line))).sort((a, b) => distance(a) - distance(b))[0]);
});
const toggle = (id, node) => {
  const box = document.getElementById(id);
  const apply = () => { node.style.display = box.checked ? "" : "none"; };
  box.addEventListener("change", apply);
  apply();
};
toggle("show-outlines", outlines);
toggle("show-names", names);
if (data.seams) toggle("show-seams", seams);
document.getElementById("in").onclick = () => viewer.viewport.zoomBy(1.5);
document.getElementById("out").onclick = () => viewer.viewport.zoomBy(1 / 1.5);
document.getElementById("home").onclick = () => { viewer.viewport.setRotation(0); viewer.viewport.goHome(); };
document.getElementById("turn").onclick = () => viewer.viewport.rotateBy(15);
// The whole page, not the viewer alone, which is without outlines and names.
document.getElementById("full").onclick = () => {
  if (document.fullscreenElement) document.exitFullscreen(); else document.documentElement.requestFullscreen();
};
