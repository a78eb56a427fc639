// Small helpers: elements, grey images, curves, bars and the map, all without a library.
export const ACTIONS = ["forward", "left", "right"];
export const $ = (id) => document.getElementById(id);
export const short = (v, digits = 3) => (v == null ? "–" : String(+v.toPrecision(digits)));

export function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value != null) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
}

export function bars(title, counts) { // {name: [count, words]} as bars of one length to another
  const most = Math.max(1, ...Object.values(counts).map(([count]) => count));
  return el("div", {}, el("h3", {}, title), el("div", { class: "bars" }, ...Object.entries(counts).flatMap(([name, [count, words]]) => {
    const bar = el("i");
    bar.style.width = `${(100 * count) / most}%`;
    return [el("span", {}, name), el("div", { class: "bar" }, bar), el("span", {}, words ?? count)];
  })));
}

export function text(element, value) { // untouched if it is the same: nothing is read out again
  if (element.textContent !== value) element.textContent = value;
}

export function list(element, lines, empty) {
  const wanted = lines.length ? lines : [empty];
  if (element.dataset.shown === wanted.join("\n")) return;
  element.dataset.shown = wanted.join("\n");
  element.replaceChildren(...wanted.map((line) => el("li", lines.length ? {} : { class: "dim" }, line)));
}

export function grey(canvas, base64, width = 75, height = 50) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const bytes = atob(base64), context = canvas.getContext("2d"), image = context.createImageData(width, height);
  for (let i = 0; i < bytes.length; i++) {
    image.data.fill(bytes.charCodeAt(i), 4 * i, 4 * i + 3);
    image.data[4 * i + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

export function picture(sample, label) {
  const canvas = el("canvas", { role: "img", "aria-label": label });
  grey(canvas, sample.image);
  return canvas;
}

function sized(canvas) { // as many pixels as the screen shows
  const ratio = devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  context.font = "11px system-ui, sans-serif";
  return [context, width, height];
}

const colour = (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`);

export function curve(canvas, data, marks = []) {
  const [context, width, height] = sized(canvas), names = Object.keys(data.y), [left, bottom] = [36, 16];
  const all = names.flatMap((name) => data.y[name]).filter((v) => v != null);
  if (!all.length) return;
  const low = Math.min(0, ...all), top = Math.max(...all), high = top > low ? top : low + 1, [first, last] = [data.x[0], data.x.at(-1)];
  const X = (x) => left + ((x - first) / Math.max(1, last - first)) * (width - left - 4);
  const Y = (y) => 6 + (1 - (y - low) / (high - low)) * (height - bottom - 8);
  context.fillStyle = colour("dim");
  context.strokeStyle = colour("line");
  for (const [value, at] of [[high, Y(high) + 8], [low, Y(low)]]) context.fillText(short(value), 0, at);
  context.strokeRect(left, Y(low), width - left, 0);
  context.fillText(first, left, height - 2);
  context.fillText(last, width - context.measureText(last).width, height - 2);
  for (const mark of marks) if (mark >= first && mark <= last) context.strokeRect(X(mark), 6, 0, Y(low) - 6);
  names.forEach((name, n) => {
    context.strokeStyle = colour(n ? "dim" : "accent");
    context.setLineDash([[], [5, 3], [2, 2]][n % 3]);
    context.lineWidth = 1.5;
    context.beginPath();
    data.y[name].forEach((y, i) => { if (y != null) context.lineTo(X(data.x[i]), Y(y)); });
    context.stroke();
  });
}

export function map(canvas, world, boxes, robots) { // returns what turns a place on it into metres
  const [context, width, height] = sized(canvas), places = robots.flatMap((robot) => [...robot.trail, robot.pose]);
  const [x0, y0, x1, y1] = world?.bounds ?? [
    Math.min(...places.map((p) => p[0])) - 1, Math.min(...places.map((p) => p[1])) - 1,
    Math.max(...places.map((p) => p[0])) + 1, Math.max(...places.map((p) => p[1])) + 1];
  const scale = Math.min((width - 16) / (x1 - x0), (height - 16) / (y1 - y0));
  const dx = (width - scale * (x1 - x0)) / 2, dy = (height - scale * (y1 - y0)) / 2;
  const at = ([x, y]) => [dx + scale * (x - x0), dy + scale * (y1 - y)];
  const path = (points) => { context.beginPath(); points.forEach((p) => context.lineTo(...at(p))); };
  const dot = (place, radius, name) => {
    context.fillStyle = colour(name);
    context.beginPath();
    context.arc(...at(place), radius, 0, 7);
    context.fill();
  };
  context.lineWidth = 1.5;
  context.strokeStyle = colour("fg");
  for (const wall of world?.walls ?? []) { path(wall); context.closePath(); context.stroke(); }
  context.fillStyle = colour("dim");
  for (const box of boxes) { path(box.corners); context.fill(); context.fillText(box.name, ...at(box.corners[2])); }
  for (const { name, pose, trail, bumps } of robots) {
    context.strokeStyle = colour("accent");
    context.globalAlpha = 0.5;
    path(trail);
    context.stroke();
    context.globalAlpha = 1;
    bumps.forEach((bump) => dot(bump, 3, "stop"));
    dot(pose, 6, "accent");
    context.lineWidth = 3;
    path([pose, [pose[0] + (14 / scale) * Math.cos(pose[2]), pose[1] + (14 / scale) * Math.sin(pose[2])]]);
    context.stroke();
    context.lineWidth = 1.5;
    context.fillStyle = colour("fg");
    const [x, y] = at(pose);
    context.fillText(name, x + 9, y - 9);
  }
  return (x, y) => [x0 + (x - dx) / scale, y1 - (y - dy) / scale];
}
