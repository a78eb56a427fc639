// The memory: a wall of its images, one sample in detail, what went last, what a threshold would mark.
import { $, ACTIONS, bars, el, picture, short } from "./draw.js";

const PAGE = 48, filter = { action: "", world: "", candidate: "", least: "", most: "", youngest: "", oldest: "", bits: "" };
const bits = (count) => `${count} bit${count === 1 ? "" : "s"}`, each = (tell) => ACTIONS.map(tell).join(", ");
let page = 0, asked = 0;

async function ask(what, query = {}) {
  const given = Object.entries(query).filter(([, value]) => value !== "");
  const answer = await fetch(`/memory/${what}?${new URLSearchParams(given)}`), told = await answer.json();
  if (!answer.ok) throw new Error(told.error);
  return told;
}

export async function openMemory() {
  if (!$("wall")) $("memory").replaceChildren(...layout());
  try {
    overview(await ask("overview"));
    await Promise.all([wall(), discard()]);
  } catch (error) { $("counts").textContent = `The memory cannot be shown: ${error.message}.`; }
}

function section(id, title, ...children) {
  return el("section", { class: "wide", "aria-labelledby": `h-${id}` }, el("h2", { id: `h-${id}` }, title), ...children);
}

function show(name, value) {
  filter[name] = value;
  page = 0;
  wall();
}

function field(name, label, choices) {
  const attributes = { name, onchange: (event) => show(name, event.target.value) };
  return el("label", {}, label, choices ? el("select", attributes, ...choices.map(([value, word]) => el("option", { value }, word)))
    : el("input", { ...attributes, type: "number", step: "any" }));
}

function layout() {
  const turn = (word, by) => el("button", { type: "button", onclick: () => { page = Math.max(0, page + by); wall(); } }, word);
  const slider = { id: "bits", type: "range", min: -1, max: 24, value: -1, onchange: ({ target }) => show("bits", +target.value < 0 ? "" : target.value),
    oninput: ({ target: { value } }) => { $("bits-text").textContent = `Threshold: ${value < 0 ? "not used" : `${bits(+value)} of 120, ${short(value / 1.2)} %`}`; } };
  return [
    section("counts", "What is in the memory", el("p", { class: "hint" },
      "The robot keeps each image that it acted on, with the action and the reward that followed. When the memory is full, some samples must go. "
      + "Replay memory management lets those go that look like newer samples of the same action, and only of actions above their third. "
      + "So rare views stay, and no corridor is forgotten."),
      el("p", { id: "counts" }), el("div", { id: "parts", class: "counts" }), el("button", { type: "button", onclick: openMemory }, "Look again")),
    section("wall", "Images", el("form", { id: "filters" },
      field("action", "Action", [["", "all"], ...ACTIONS.map((name, n) => [n, name])]), field("world", "World", [["", "all"]]),
      field("candidate", "Candidate", [["", "all"], ["true", "yes"], ["false", "no"]]),
      field("least", "Reward from"), field("most", "to"), field("youngest", "Age in episodes from"), field("oldest", "to")),
      el("label", {}, el("span", { id: "bits-text" }, "Threshold: not used"), el("input", slider)),
      el("p", { class: "hint" }, "Each image is described by 120 bits. A threshold marks each sample that differs from a newer one of its action "
        + "in at most so many bits. Move the slider to see what would be marked."),
      el("p", { id: "found", role: "status" }), el("div", { id: "wall", class: "wall" }), el("p", { class: "buttons" }, turn("Newer", -1), turn("Older", 1))),
    section("sample", "One sample", el("div", { id: "sample" }, el("p", { class: "hint" }, "Choose an image above."))),
    section("gone", "What the last discard removed", el("p", { id: "gone" }), el("div", { id: "pairs", class: "wall pairs" })),
  ];
}

function overview(told) {
  const [edges, counts] = told.ages, worlds = Object.entries(told.worlds), choice = $("filters").elements.world;
  $("counts").textContent = `${told.size} of ${told.capacity} samples at episode ${told.turn}. Strategy ${told.strategy}, `
    + `threshold ${told.threshold_percent} %. ${told.described} samples have a descriptor.`;
  $("parts").replaceChildren(
    bars("By action", Object.fromEntries(ACTIONS.map((name, n) => [name, [told.by_action[n], `${told.by_action[n]}, candidates ${told.candidates[n]}`]]))),
    bars("By world", Object.fromEntries(worlds.map(([name, count]) => [name, [count]]))),
    bars("By age in episodes", { ...Object.fromEntries(counts.map((count, n) => [`${edges[n]} to ${edges[n + 1]}`, [count]])), "from the filling": [told.fill] }));
  for (const [name] of worlds.slice(choice.options.length - 1)) choice.append(el("option", { value: name }, name));
}

function tile(sample, ...words) {
  const label = `Sample ${sample.id}, ${ACTIONS[sample.action]}, reward ${short(sample.reward)}`;
  return el("button", { type: "button", onclick: () => detail(sample.id) }, picture(sample, label), ...words.flatMap((word) => [el("span", {}, word), el("br")]));
}

async function wall() {
  const mine = ++asked;
  $("found").textContent = "Looking …";
  try {
    const { count, by_action, samples } = await ask("samples", { ...filter, page });
    if (mine !== asked) return; // a newer question is under way
    $("found").textContent = `${count} samples${filter.bits === "" ? "" : " would be marked"}: ${each((name, n) => `${name} ${by_action[n]}`)}. `
      + `Page ${page + 1} of ${Math.max(1, Math.ceil(count / PAGE))}, newest first.`;
    $("wall").replaceChildren(...samples.map((s) => tile(s, `${ACTIONS[s.action]} ${short(s.reward)}`, s.candidate ? "candidate" : `episode ${s.episode}`)));
  } catch (error) { $("found").textContent = error.message; }
}

async function detail(id) {
  const box = $("sample"), told = await ask("sample", { id }).catch((error) => ({ error: error.message }));
  if (told.error) return box.replaceChildren(el("p", {}, told.error));
  const guess = el("p", {}, "Prediction: asking the network …"), { descriptor, neighbours = [], pose: [x, y, heading] } = told;
  const lines = [
    `Reward ${short(told.reward_observed)} as observed, ${told.there ? `${short(told.reward)} now` : "just discarded"}. Old rewards move towards what the network predicts.`,
    `${told.robot}, step ${told.step} of its episode ${told.robot_episode}, episode ${told.episode} of the run, which ended by ${told.ended}; network version ${told.version}; `
      + `${told.world} at ${x} m, ${y} m, ${short(heading)} rad; robot life ${told.robot_life}, actor life ${told.life}.`];
  const marked = told.forced ? "Marked by decree. " : told.candidate ? "A candidate: it looked like a newer sample. " : "No candidate. ";
  box.replaceChildren(el("div", { class: "sample" }, picture(told, `Sample ${id}`), el("div", {}, el("h3", {}, `Sample ${id}: ${ACTIONS[told.action]}`),
    ...lines.map((line) => el("p", {}, line)), guess, el("div", { class: "bits120", role: "img", "aria-label": "The 120 bits of its descriptor" },
      ...(descriptor ?? []).map((bit) => el("i", { class: bit ? "on" : "off" }))))),
  el("p", { class: "hint" }, descriptor ? `${marked}Its nearest neighbours of the same action, and in how many bits they differ:`
    : "It has no descriptor yet: the next search for candidates makes one."),
  el("div", { class: "wall" }, ...neighbours.map((s) => tile(s, `${bits(s.bits)}, ${s.id > id ? "newer" : "older"}`, `reward ${short(s.reward)}`))));
  box.scrollIntoView({ block: "nearest" });
  ask("prediction", { id }).then(
    ({ values, episode }) => { guess.textContent = `Predicted by the network of episode ${episode}: ${each((name, n) => `${name} ${values[n].toFixed(3)}`)}.`; },
    (error) => { guess.textContent = `No prediction: ${error.message}.`; });
}

async function discard() {
  const { count, reasons, samples } = await ask("discard");
  $("gone").textContent = count ? `${count} samples went: ${reasons.alike} because they looked like newer ones, ${reasons.decree} by decree, `
    + `${reasons.age} by age, because candidates ran out or the strategy goes by age. Left is what went, right the newer sample of its action that it is most like.`
    : "Nothing has been discarded yet.";
  $("pairs").replaceChildren(...samples.map((s) => el("div", { class: "pair" }, tile(s, `went, ${s.why}`), s.like ? tile(s.like, `${bits(s.like.bits)} from it`) : "")));
}
