// Taking a robot over: hold a key, a button or a gamepad. Letting go lets the robot stand.
import { ACTIONS, el, text } from "./draw.js";

const KEYS = { ArrowUp: 0, w: 0, ArrowLeft: 1, a: 1, ArrowRight: 2, d: 2 }, PERIOD_MS = 50;
let send = null, driven = "", held = null;

function fromGamepad() { // stick or cross: up drives, sideways turns
  for (const pad of navigator.getGamepads?.() ?? []) {
    const x = pad?.axes[0] ?? 0, pressed = (n) => pad?.buttons[n]?.pressed;
    if (x < -0.5 || pressed(14)) return 1;
    if (x > 0.5 || pressed(15)) return 2;
    if ((pad?.axes[1] ?? 0) < -0.5 || pressed(12)) return 0;
  }
  return null;
}

export function wheel(name, sender) {
  send = sender;
  const hold = (action) => ({ onpointerdown: () => { held = action; }, onpointerup: letGo, onpointerleave: letGo });
  return el("details", { class: "takeover", id: `wheel-${name}` }, el("summary", {}, "Drive it yourself"),
    el("p", { class: "hint" }, "Hold w, a, d, the arrows, a gamepad's stick or a button. Let go, and it stands, until you give it back."),
    el("p", { class: "buttons" },
      el("button", { type: "button", onclick: () => take(name) }, "Take over"),
      ...ACTIONS.map((action, n) => el("button", { type: "button", disabled: "", "aria-label": `Hold to drive ${name} ${action}`, ...hold(n) }, action)),
      el("button", { type: "button", onclick: () => giveBack(name) }, "Give back")),
    el("p", { class: "hint", role: "status" }));
}

function letGo() { held = null; }
function take(name) {
  if (driven && driven !== name) send({ robot: driven, wish: {} });
  driven = name;
}
function giveBack(name) {
  if (driven === name) driven = "";
  letGo();
  for (let n = 0; n < 3; n++) setTimeout(() => send({ robot: name, wish: { give_back: true } }), n * 100);
}

export function paintWheel(name, actor) {
  const shown = document.getElementById(`wheel-${name}`);
  for (const button of shown.querySelectorAll("[aria-label]")) button.disabled = driven !== name;
  const share = actor.human_actions ? `${actor.human_actions} of ${actor.actions} actions by persons.` : "";
  const gone = actor.person_silent_s > 3 ? "Nobody drives it: it stands until it is given back." : "A person drives it.";
  text(shown.lastChild, `${actor.taken_over ? gone : ""} ${share}`.trim());
  if (actor.taken_over) shown.open = true;
}

document.addEventListener("keydown", (event) => {
  if (!driven || !(event.key in KEYS) || event.target.closest("input, select")) return;
  event.preventDefault();
  held = KEYS[event.key];
});
document.addEventListener("keyup", (event) => { if (KEYS[event.key] === held) letGo(); });
addEventListener("blur", letGo);
setInterval(() => {
  const action = held ?? (driven ? fromGamepad() : null);
  if (driven) send({ robot: driven, wish: action == null ? {} : { action } });
}, PERIOD_MS);
