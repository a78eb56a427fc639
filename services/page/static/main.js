// The run: one WebSocket brings sections of what changed, each is painted and acknowledged.
import { $, ACTIONS, curve, el, grey, list, map, short, text } from "./draw.js";
import { openMemory } from "./memory.js";

const SILENT_MS = 3000, token = location.hash.slice(1), known = {};
let socket = null, backoff = 500, heard = 0, toMetres = null, chosen = "";

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return alarm("NOT sent: the page process does not answer.");
  socket.send(JSON.stringify({ token, ...message }));
}
const order = (name, robot = null) => send({ order: name, robot });

function alarm(words) {
  text($("alert"), words);
  $("alert").hidden = !words;
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/updates`);
  socket.onmessage = (event) => {
    const { number, sections, refused } = JSON.parse(event.data);
    if (refused) return alarm(`Refused: ${refused}`);
    heard = Date.now();
    backoff = 500;
    Object.assign(known, sections);
    try { paint(sections); } finally { socket.send(JSON.stringify({ seen: number })); }
  };
  socket.onclose = () => {
    lost();
    setTimeout(connect, backoff * (0.5 + Math.random() / 2));
    backoff = Math.min(2 * backoff, 8000);
  };
}

function lost() {
  document.body.classList.add("lost");
  const since = heard ? ` What you see is as it was at ${new Date(heard).toLocaleTimeString()}.` : "";
  alarm(`The page process does not answer; trying again.${since}`);
}
setInterval(() => { if (heard && Date.now() - heard > SILENT_MS) lost(); }, 500);

function paint(fresh) {
  const { state } = known, away = !state.connected && Object.keys(state.services).length > 0;
  if (document.body.classList.contains("lost") !== away) {
    document.body.classList.toggle("lost", away);
    alarm(away ? "No router answers: the run is not up. What you see is old." : "");
  }
  paintState(state);
  paintRobots();
  if (fresh.maps || fresh.robots || fresh.trails || fresh.obstacles) paintMap();
  if (fresh.curves || fresh.notes) paintCurves();
  list($("findings"), known.findings ?? [], "Nothing found.");
  list($("notes"), (known.notes ?? []).map((n) => `${n.time}, episode ${n.episode}: ${n.text}`).reverse(), "None yet.");
  list($("told"), (known.told ?? []).map((t) => `${t.at} ${t.what}, ${t.robot}: ${t.lines.join("; ") || "…"}`).reverse(),
    token ? "None yet." : "This address has no token: it shows the run, but commands nothing.");
}

function paintState(state) {
  const { replay = {}, learner = {} } = state.services;
  text($("run"), state.run);
  document.title = `${state.run}, Corridor`;
  const rate = ACTIONS.map((name, n) => `${name} ${replay.by_action?.[n] ?? "–"}`).join(", ");
  facts($("numbers"), {
    "Episode": replay.episode, "Fitness, mean of 100": replay.episode ? short(replay.fitness_mean_100) : "–",
    "Bumps": replay.bumps, "Laps left, right": replay.episode == null ? "–" : `${replay.laps_left}, ${replay.laps_right}`,
    "Actions": replay.actions, "Training steps": learner.train_steps, "Loss": short(learner.loss),
    "Network version": learner.weights_version, "Memory": `${replay.size ?? "–"} of ${replay.capacity ?? "–"}`,
  });
  text($("doing"), state.replay ? `Learner: ${state.learner}. Memory: ${state.replay}; ${rate}.` : "Waiting for services.");
  $("progress").value = replay.filling ? replay.size / replay.capacity : learner.activity === "fitting" ? state.fitting : 0;
  const lost = state.lost ? [`${state.lost} messages were too many for the page`] : [];
  list($("warnings"), [...state.warnings, ...lost], "None.");
  const robots = Object.entries(state.services).filter(([name]) => name.startsWith("robot "));
  const stand = robots.filter(([, robot]) => robot.state === "estop").map(([, robot]) => robot.robot);
  text($("stands"), stand.length ? `Stopped: ${stand.join(", ")} stand${stand.length > 1 ? "" : "s"} (${stand.length} of ${robots.length}).` : "");
  $("services").replaceChildren(...Object.entries(state.services).map(([name, s]) => {
    const behind = s.weights_version == null ? 0 : Math.max(0, (learner.weights_version ?? 0) - s.weights_version);
    return el("tr", {}, ...[
      name, `${s.silent ? "silent, " : ""}${s.age_s.toFixed(1)} s ago`,
      s.weights_version == null ? "" : `${s.weights_version}${behind ? `, ${behind} behind` : ""}`,
      s.reply ? `${Math.round(s.reply.uptime_s)} s` : "", s.reply?.version ?? "", s.reply ? `${s.reply.host}, ${s.reply.pid}` : "", s.life,
    ].map((value) => el("td", s.silent ? { class: "chosen" } : {}, value)));
  }));
}

function facts(element, values) {
  if (!element.children.length) for (const name in values) element.append(el("div", {}, el("dt", {}, name), el("dd")));
  Object.values(values).forEach((value, n) => text(element.children[n].lastChild, String(value ?? "–")));
}

function card(name) {
  const buttons = { estop: "Stop", clear: "Clear", pause: "Pause", resume: "Resume" };
  return el("article", { class: "robot", id: `robot-${name}` },
    el("h3", {}, name), el("canvas", { role: "img", width: 75, height: 50 }),
    el("div", { class: "bars" }, ...ACTIONS.flatMap((action) => [
      el("span", {}, action), el("div", { class: "bar" }, el("i")), el("span", {}, "–")])),
    el("p", { class: "hint" }),
    el("p", { class: "buttons" }, ...Object.entries(buttons).map(([what, word]) => el("button",
      { type: "button", "data-order": what, "data-robot": name, "aria-label": `${word} ${name}` }, word))),
    el("div", { class: "takeover", "data-robot": name }));
}

function paintRobots() {
  const names = Object.keys(known.state.services).filter((n) => n.startsWith("robot ")).map((n) => n.slice(6));
  for (const name of new Set([...names, ...Object.keys(known.robots)])) {
    const shown = $(`robot-${name}`) ?? $("robots").appendChild(card(name));
    const seen = known.robots[name] ?? {}, robot = known.state.services[`robot ${name}`] ?? {};
    const actor = known.state.services[`actor of ${name}`] ?? {}, [, image, bars, words] = shown.children;
    if (seen.image) grey(image, seen.image);
    image.setAttribute("aria-label", `What ${name} sees`);
    ACTIONS.forEach((_, action) => {
      const [label, bar, number] = [...bars.children].slice(3 * action), value = seen.values?.[action];
      label.className = seen.action === action ? "chosen" : "";
      text(label, ACTIONS[action] + (seen.action === action ? (seen.greedy ? " ◂" : " ◂ by chance") : ""));
      text(number, value == null ? "–" : value.toFixed(2));
      Object.assign(bar.firstChild.style, { left: `${50 + 50 * Math.min(0, value ?? 0)}%`, width: `${50 * Math.abs(value ?? 0)}%` });
    });
    const [middle, high] = seen.latency_ms ?? [];
    text(words, [`${robot.state ?? "unknown"} in ${robot.world ?? seen.world}`, actor.phase && `actor ${actor.phase}, step ${actor.step}`,
      `bumps ${robot.bumps ?? "–"}, laps ${robot.laps_left ?? "–"} left ${robot.laps_right ?? "–"} right`,
      actor.actions_per_s != null && `${actor.actions_per_s.toFixed(1)} actions/s`,
      middle != null && `answered after ${middle} ms (p50), ${high} ms (p95)`, robot.reason].filter(Boolean).join(" · "));
  }
}

function options(select, values) {
  if (select.options.length === values.length && values.every((v, n) => select.options[n].value === v)) return;
  const before = select.value;
  select.replaceChildren(...values.map((value) => el("option", { value }, value || "all robots")));
  if (values.includes(before)) select.value = before;
}

function paintMap() {
  const robots = Object.entries(known.robots ?? {}).filter(([, robot]) => robot.pose);
  options($("map-robot"), ["", ...robots.map(([name]) => name)]);
  options($("change").elements.world, known.worlds ?? []);
  if (!robots.length) return;
  chosen = $("map-robot").value || robots[0][0];
  const { world } = known.robots[chosen], here = robots.filter(([, robot]) => robot.world === world);
  toMetres = map($("map"), known.maps[world], known.obstacles?.[chosen] ?? [], here.map(([name, robot]) => (
    { name, pose: robot.pose, trail: known.trails[name][0], bumps: known.trails[name][1] })));
  text($("map-text"), `World ${world}. ${here.map(([name, { pose: [x, y, h] }]) =>
    `${name} at ${x.toFixed(1)} m, ${y.toFixed(1)} m, heading ${Math.round((h * 180) / Math.PI)}°, bumps shown ${known.trails[name][1].length}`).join(". ")}.`);
}

const CURVES = { fitness: "Fitness, mean of 100 episodes", bumps: "Bumps in 1,000 actions", laps: "Laps", loss: "Loss",
  threshold: "Similarity threshold, percent", actions: "Samples by action", worlds: "Samples by world",
  discarded: "Samples discarded, and as a last resort by age" };

function paintCurves() {
  for (const [name, data] of Object.entries(known.curves ?? {})) {
    if (!data.x.length || !Object.keys(data.y).length) continue;
    const shown = $(`curve-${name}`) ?? $("curves").appendChild(el("figure", { id: `curve-${name}` },
      el("figcaption", {}, el("b", {}, CURVES[name]), el("br"), el("span")),
      el("canvas", { role: "img", "aria-label": `${CURVES[name]} over episodes` })));
    const names = Object.keys(data.y), last = (n) => data.y[n].findLast((v) => v != null);
    text(shown.querySelector("span"), names.map((n, i) => `${"— ┅ ┈".split(" ")[i % 3]} ${n.replace("_", " ")} ${short(last(n))}`).join("  "));
    curve(shown.lastChild, data, (known.notes ?? []).map((note) => note.episode));
  }
}

function change(kind, place = null) {
  const form = $("change").elements, side = +form.side.value, robot = form.robot.value || null;
  const [x_m, y_m] = place ?? [+form.x.value, +form.y.value];
  const box = { name: form.name.value, x_m, y_m, length_m: side, width_m: side, height_m: 0.5, rgb: [200, 60, 40] };
  send({ robot, change: { switch: { kind, world: form.world.value }, place: { kind, box }, remove: { kind, name: form.name.value } }[kind] });
}

$("map").addEventListener("click", ({ offsetX, offsetY }) => {
  if (!$("edit").checked || !toMetres) return;
  const [x, y] = toMetres(offsetX, offsetY).map((v) => +v.toFixed(2)), form = $("change").elements, boxes = known.obstacles?.[chosen] ?? [];
  const hit = boxes.find(({ corners }) => corners.every(([ax, ay], i) => {
    const [bx, by] = corners[(i + 1) % 4];
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0;
  }));
  Object.assign(form.x, { value: x });
  Object.assign(form.y, { value: y });
  let free = 1;
  while (boxes.some((box) => box.name === `box${free}`)) free++;
  form.name.value = hit ? hit.name : `box${free}`;
  change(hit ? "remove" : "place", [x, y]);
});
$("note").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ note: event.target.elements.text.value });
  event.target.reset();
});
document.addEventListener("click", (event) => {
  const { order: name, robot, change: kind, view } = event.target.dataset;
  if (name) order(name, robot);
  if (kind) change(kind);
  if (view) {
    for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", button.dataset.view === view);
    $("live").hidden = view !== "live";
    $("memory").hidden = view !== "memory";
    if (view === "memory") openMemory();
  }
  if (event.detail) event.target.blur?.(); // else the next space would press it again, and stop nothing
});
document.addEventListener("keydown", (event) => {
  const inside = event.target.closest("input, select, button, summary, a");
  if (event.key !== "Escape" && (event.key !== " " || inside)) return;
  event.preventDefault();
  order("estop");
});
connect();
