// Small helpers: elements, grey images, curves, bars and the map, all without a library.
export const ACTIONS = ["forward", "left", "right"];
export const $ = (id) => document.getElementById(id);
export const short = (value, digits = 3) => (value == null ? "–" : String(+value.toPrecision(digits)));

export function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function text(element, value) { // untouched if it is the same: nothing is read out again
  if (element.textContent !== value) element.textContent = value;
}

export function list(element, lines, empty) {
  const shown = lines.join("\n") || empty;
  if (element.dataset.shown === shown) return;
  element.dataset.shown = shown;
  element.replaceChildren(...(lines.length ? lines.map((line) => el("li", {}, line)) : [el("li", { class: "dim" }, empty)]));
}

export function grey(canvas, base64) {
  const bytes = atob(base64), context = canvas.getContext("2d"), image = context.createImageData(75, 50);
  for (let i = 0; i < bytes.length; i++) image.data.set([bytes.charCodeAt(i), bytes.charCodeAt(i), bytes.charCodeAt(i), 255], 4 * i);
  context.putImageData(image, 0, 0);
}

export function picture(sample, label) {
  const canvas = el("canvas", { role: "img", "aria-label": label, width: 75, height: 50 });
  grey(canvas, sample.image);
  return canvas;
}

export function bars(title, counts) { // {name: [count, words]}, the longest bar for the largest count
  const most = Math.max(1, ...Object.values(counts).map(([count]) => count));
  return el("div", {}, el("h3", {}, title), el("div", { class: "bars" }, ...Object.entries(counts).flatMap(([name, [count, words]]) => {
    const bar = el("i");
    bar.style.width = `${(100 * count) / most}%`;
    return [el("span", {}, name), el("div", { class: "bar" }, bar), el("span", {}, words ?? count)];
  })));
}

const colour = (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`);

function sized(canvas) { // as many pixels as the screen shows
  const ratio = devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas, context = canvas.getContext("2d");
  Object.assign(canvas, { width: width * ratio, height: height * ratio });
  context.scale(ratio, ratio);
  context.font = "11px system-ui, sans-serif";
  return [context, width, height];
}

export function curve(canvas, data, marks) {
  const [context, width, height] = sized(canvas), series = Object.values(data.y), left = 36, bottom = 16;
  const all = series.flat().filter((v) => v != null), low = Math.min(0, ...all), top = Math.max(...all), high = top > low ? top : low + 1;
  const first = data.x[0], last = data.x.at(-1), X = (x) => left + ((x - first) / Math.max(1, last - first)) * (width - left - 4);
  const Y = (y) => 6 + (1 - (y - low) / (high - low)) * (height - bottom - 8);
  Object.assign(context, { fillStyle: colour("dim"), strokeStyle: colour("line") });
  context.fillText(short(high), 0, Y(high) + 8);
  context.fillText(short(low), 0, Y(low));
  context.strokeRect(left, Y(low), width - left, 0);
  context.fillText(first, left, height - 2);
  context.fillText(last, width - context.measureText(last).width, height - 2);
  for (const mark of marks) if (mark >= first && mark <= last) context.strokeRect(X(mark), 6, 0, Y(low) - 6);
  series.forEach((values, n) => {
    Object.assign(context, { strokeStyle: colour(n ? "dim" : "accent"), lineWidth: 1.5 });
    context.setLineDash([[], [5, 3], [2, 2]][n % 3]);
    context.beginPath();
    values.forEach((y, i) => { if (y != null) context.lineTo(X(data.x[i]), Y(y)); });
    context.stroke();
  });
}

export function map(canvas, world, boxes, robots) { // returns what turns a place on it into metres
  const [context, width, height] = sized(canvas), places = robots.flatMap(({ trail, pose }) => [...trail.filter(Boolean), pose]);
  const [xs, ys] = [0, 1].map((n) => places.map((place) => place[n]));
  const [x0, y0, x1, y1] = world?.bounds ?? [Math.min(...xs) - 1, Math.min(...ys) - 1, Math.max(...xs) + 1, Math.max(...ys) + 1];
  const scale = Math.min((width - 16) / (x1 - x0), (height - 16) / (y1 - y0));
  const dx = (width - scale * (x1 - x0)) / 2, dy = (height - scale * (y1 - y0)) / 2, at = ([x, y]) => [dx + scale * (x - x0), dy + scale * (y1 - y)];
  const path = (points) => { // null: the line breaks off
    context.beginPath();
    points.forEach((point, i) => point && (points[i - 1] ? context.lineTo(...at(point)) : context.moveTo(...at(point))));
  };
  const dot = (place, radius, name) => {
    context.fillStyle = colour(name);
    context.beginPath();
    context.arc(...at(place), radius, 0, 7);
    context.fill();
  };
  Object.assign(context, { lineWidth: 1.5, strokeStyle: colour("fg"), fillStyle: colour("dim") });
  for (const wall of world?.walls ?? []) { path([...wall, wall[0]]); context.stroke(); }
  for (const box of boxes) { path(box.corners); context.fill(); context.fillText(box.name, ...at(box.corners[2])); }
  for (const { name, pose: [x, y, heading], trail, bumps } of robots) {
    Object.assign(context, { strokeStyle: colour("accent"), lineWidth: 1.5, globalAlpha: 0.5 });
    path(trail);
    context.stroke();
    Object.assign(context, { globalAlpha: 1, lineWidth: 3 });
    bumps.forEach((bump) => dot(bump, 3, "stop"));
    dot([x, y], 6, "accent");
    path([[x, y], [x + (14 / scale) * Math.cos(heading), y + (14 / scale) * Math.sin(heading)]]);
    context.stroke();
    context.fillStyle = colour("fg");
    context.fillText(name, at([x, y])[0] + 9, at([x, y])[1] - 9);
  }
  return (x, y) => [x0 + (x - dx) / scale, y1 - (y - dy) / scale];
}
