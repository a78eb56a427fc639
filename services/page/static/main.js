// The run: one WebSocket brings sections of what changed; each update is painted and acknowledged.
import { $, ACTIONS, curve, el, grey, list, map, short, text } from "./draw.js";
import { openMemory } from "./memory.js";
import { paintWheel, wheel } from "./wheel.js";

const SILENT_MS = 3000, token = location.hash.slice(1), known = {};
let socket, backoff_ms = 500, heard_ms = 0, gone = false, toMetres = null, chosen = "";

function send(message) {
  if (socket.readyState !== WebSocket.OPEN) return alarm("NOT sent: the page process does not answer.");
  if (!document.body.classList.contains("lost")) alarm("");
  socket.send(JSON.stringify({ token, ...message }));
}

function alarm(words) {
  text($("alert"), words);
  $("alert").hidden = !words;
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/updates`);
  socket.onmessage = ({ data }) => {
    const { number, sections, refused } = JSON.parse(data);
    if (refused) return alarm(`Refused: ${refused}`);
    [heard_ms, backoff_ms, gone] = [Date.now(), 500, false];
    Object.assign(known, sections);
    try { paint(sections); } finally { socket.send(JSON.stringify({ seen: number })); }
  };
  socket.onclose = () => {
    lost();
    setTimeout(connect, backoff_ms * (0.5 + Math.random() / 2));
    backoff_ms = Math.min(2 * backoff_ms, 8000);
  };
}

function lost() {
  if (gone) return; // what was told since stays
  gone = true;
  document.body.classList.add("lost");
  alarm("The page process does not answer; trying again."
    + (heard_ms ? ` What you see is as it was at ${new Date(heard_ms).toLocaleTimeString()}.` : ""));
}
setInterval(() => { if (heard_ms && Date.now() - heard_ms > SILENT_MS) lost(); }, 500);

function paint(fresh) {
  const { state, notes = [], told = [] } = known, away = !state.connected && Object.keys(state.services).length > 0;
  if (document.body.classList.contains("lost") !== away) {
    document.body.classList.toggle("lost", away);
    alarm(away ? "No router answers: the run is not up. What you see is old." : "");
  }
  paintState(state);
  paintRobots(state);
  if (fresh.maps || fresh.robots || fresh.trails || fresh.obstacles) paintMap();
  if (fresh.curves || fresh.notes) paintCurves(notes);
  list($("findings"), known.findings ?? [], "Nothing found.");
  list($("notes"), notes.map((n) => `${n.time}, episode ${n.episode}: ${n.text}`).reverse(), "None yet.");
  list($("told"), told.map((t) => `${t.at} ${t.what}, ${t.robot}: ${t.lines.join("; ") || "…"}`).reverse(),
    token ? "None yet." : "This address has no token: it shows the run, but commands nothing.");
}

function paintState({ run, services, replay: doing, learner: learning, fitting, lost, warnings }) {
  const { replay = {}, learner = {} } = services, robots = Object.entries(services).filter(([name]) => name.startsWith("robot "));
  text($("run"), run);
  document.title = `${run}, Corridor`;
  const facts = {
    "Episode": replay.episode, "Fitness, mean of 100": replay.episode ? short(replay.fitness_mean_100) : null, "Bumps": replay.bumps,
    "Laps left, right": replay.id && `${replay.laps_left}, ${replay.laps_right}`, "Actions": replay.actions, "Training steps": learner.train_steps,
    "Loss": short(learner.loss), "Network version": learner.weights_version, "Memory": replay.id && `${replay.size} of ${replay.capacity}`,
  };
  if (!$("numbers").children.length) $("numbers").append(...Object.keys(facts).map((name) => el("div", {}, el("dt", {}, name), el("dd"))));
  Object.values(facts).forEach((value, n) => text($("numbers").children[n].lastChild, String(value ?? "–")));
  const held = ACTIONS.map((name, n) => `${name} ${replay.by_action?.[n]}`).join(", ");
  text($("doing"), doing ? `Learner: ${learning}. Memory: ${doing}; ${held}.` : "Waiting for services.");
  $("progress").value = replay.filling ? replay.size / replay.capacity : fitting ?? 0;
  list($("warnings"), [...warnings, ...(lost ? [`${lost} messages were too many for the page`] : [])], "None.");
  const stand = robots.filter(([, robot]) => robot.state === "estop").map(([, { robot }]) => robot);
  text($("stands"), stand.length ? `Stopped: ${stand.join(", ")} (${stand.length} of ${robots.length} stand).` : "");
  $("services").replaceChildren(...Object.entries(services).map(([name, { age_s, silent, weights_version: version, reply, life }]) => {
    const behind = version == null ? 0 : Math.max(0, (learner.weights_version ?? 0) - version);
    const cells = [name, `${silent ? "silent, " : ""}${age_s.toFixed(1)} s ago`, `${version ?? ""}${behind ? `, ${behind} behind` : ""}`,
      ...(reply ? [`${Math.round(reply.uptime_s)} s`, reply.version, `${reply.host}, ${reply.pid}`] : ["", "", ""]), life];
    return el("tr", {}, ...cells.map((cell) => el("td", silent ? { class: "chosen" } : {}, cell)));
  }));
}

function card(name) { // .takeover has room for what lets a person drive this robot
  return el("article", { class: "robot", id: `robot-${name}` }, el("h3", {}, name), el("canvas", { role: "img", width: 75, height: 50 }),
    el("div", { class: "bars" }, ...ACTIONS.flatMap(() => [el("span"), el("div", { class: "bar" }, el("i")), el("span")])),
    el("p", { class: "hint" }), el("p", { class: "buttons" }, ...["Stop", "Clear", "Pause", "Resume"].map((word) => el("button", {
      type: "button", "data-robot": name, "data-order": { Stop: "estop" }[word] ?? word.toLowerCase(), "aria-label": `${word} ${name}` }, word))),
    wheel(name, send));
}

function paintRobots({ services }) {
  const names = Object.keys(services).filter((name) => name.startsWith("robot ")).map((name) => name.slice(6));
  for (const name of new Set([...names, ...Object.keys(known.robots)])) {
    const [, image, bars, words] = ($(`robot-${name}`) ?? $("robots").appendChild(card(name))).children;
    const seen = known.robots[name] ?? {}, robot = services[`robot ${name}`] ?? {}, actor = services[`actor of ${name}`];
    if (seen.image) grey(image, seen.image);
    image.setAttribute("aria-label", `What ${name} sees`);
    ACTIONS.forEach((action, n) => {
      const [label, bar, number] = [...bars.children].slice(3 * n), value = seen.values?.[n] ?? 0;
      label.className = seen.action === n ? "chosen" : "";
      text(label, action + (seen.action === n ? ({ network: " ◂", chance: " ◂ by chance", human: " ◂ by a person" }[seen.by]) : ""));
      text(number, seen.values ? value.toFixed(2) : "–");
      Object.assign(bar.firstChild.style, { left: `${50 + 50 * Math.min(0, value)}%`, width: `${50 * Math.abs(value)}%` });
    });
    paintWheel(name, actor);
    const [middle, high] = seen.latency_ms ?? [];
    text(words, [`${robot.state ?? "unknown"} in ${robot.world ?? seen.world}`,
      `bumps ${robot.bumps ?? "–"}, laps ${robot.laps_left ?? "–"} left ${robot.laps_right ?? "–"} right`,
      actor && `actor ${actor.phase}, step ${actor.step}, ${actor.actions_per_s.toFixed(1)} actions/s`,
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
  const robots = Object.entries(known.robots).filter(([, robot]) => robot.pose).map(([name, robot]) => (
    { name, ...robot, trail: known.trails[name][0], bumps: known.trails[name][1] }));
  options($("map-robot"), ["", ...robots.map(({ name }) => name)]);
  options($("change").elements.world, known.worlds);
  if (!robots.length) return;
  chosen = $("map-robot").value || robots[0].name;
  const { world } = known.robots[chosen], here = robots.filter((robot) => robot.world === world);
  toMetres = map($("map"), known.maps[world], known.obstacles?.[chosen] ?? [], here);
  text($("map-text"), `World ${world}. ${here.map(({ name, pose: [x, y, h], bumps }) => `${name} at ${x.toFixed(1)} m, ${y.toFixed(1)} m, heading `
    + `${Math.round((h * 180) / Math.PI)}°, ${bumps.length} bumps shown`).join(". ")}.`);
}

const CURVES = { fitness: "Fitness, mean of 100 episodes", bumps: "Bumps in 1,000 actions", laps: "Laps", loss: "Loss",
  threshold: "Similarity threshold, percent", actions: "Samples by action", worlds: "Samples by world",
  discarded: "Samples discarded, and of them by age" };

function paintCurves(notes) {
  for (const [name, title] of Object.entries(CURVES)) {
    const data = known.curves?.[name], names = Object.keys(data?.y ?? {});
    if (!data?.x.length || !names.length) continue;
    const shown = $(`curve-${name}`) ?? $("curves").appendChild(el("figure", { id: `curve-${name}` },
      el("figcaption", {}, el("b", {}, title), el("br"), el("span")), el("canvas", { role: "img", "aria-label": `${title} over episodes` })));
    text(shown.querySelector("span"), names.map((series, n) =>
      `${"—┅┈"[n % 3]} ${series.replace("_", " ")} ${short(data.y[series].findLast((v) => v != null))}`).join("  "));
    curve(shown.lastChild, data, notes.map((note) => note.episode));
  }
}

function change(kind, place = null) {
  const form = $("change").elements, name = form.name.value, side = +form.side.value, [x_m, y_m] = place ?? [+form.x.value, +form.y.value];
  const box = { name, x_m, y_m, length_m: side, width_m: side, height_m: 0.5, rgb: [200, 60, 40] };
  const what = { switch: { world: form.world.value }, place: { box }, remove: { name } }[kind];
  send({ robot: form.robot.value || null, change: { kind, ...what } });
}

$("map").addEventListener("click", ({ offsetX, offsetY }) => {
  if (!$("edit").checked || !toMetres) return;
  const [x, y] = toMetres(offsetX, offsetY).map((v) => +v.toFixed(2)), form = $("change").elements, boxes = known.obstacles?.[chosen] ?? [];
  const left = ([ax, ay], [bx, by]) => (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0;
  const hit = boxes.find(({ corners }) => corners.every((corner, i) => left(corner, corners[(i + 1) % 4])));
  let free = 1;
  while (boxes.some((box) => box.name === `box${free}`)) free++;
  [form.x.value, form.y.value, form.name.value] = [x, y, hit?.name ?? `box${free}`];
  change(hit ? "remove" : "place", [x, y]);
});
$("note").addEventListener("submit", (event) => {
  event.preventDefault();
  send({ note: event.target.elements.text.value });
  event.target.reset();
});
document.addEventListener("click", ({ target, detail }) => {
  const { order, robot = null, change: kind, view } = target.dataset;
  if (order) send({ order, robot });
  if (kind) change(kind);
  if (view) {
    for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-pressed", button.dataset.view === view);
    for (const name of ["live", "memory"]) $(name).hidden = view !== name;
    if (view === "memory") openMemory();
  }
  if (detail) target.blur?.(); // else the next space would press it again, and stop nothing
});
document.addEventListener("keydown", (event) => {
  const inside = event.target.closest("input, select, button, summary");
  if (event.key !== "Escape" && (event.key !== " " || inside)) return;
  event.preventDefault();
  send({ order: "estop", robot: null });
});
connect();
