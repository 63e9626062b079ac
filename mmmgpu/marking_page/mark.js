// The page: two pictures side by side, their points, and the server that keeps them.

import { Keeper } from "./keeper.js";
import { Marks, SIDES, groupClass, isUnpaired, other, rounded } from "./marks.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const NAME = { a: "A", b: "B" };
const STEP = { plain: 1, fine: 0.25, coarse: 8 }; // pixels that an arrow key moves a point
const ZOOM = 1.4;

const pairs = {}; // by kind: {sizes, marks, proposal, problems, folded}
let kind = "closed";
let side = "a";
let selected = -1;
let scope = "point";
let adding = false;

const listener = (where) => ({
  select: (index) => select(index, where),
  drag: (index, step) => moveBy(step, `drag ${where} ${index}`, index, where),
  dragged: () => pair().marks.endAction(),
  place: (at) => (adding ? place(at, where) : select(-1, where)),
  look: () => where === "b" && warped.follow(views.b),
});
const views = { a: new View($("picture-a"), "a", listener("a")), b: new View($("picture-b"), "b", listener("b")) };
const warped = new View($("warped"), "b");

const pair = () => pairs[kind];
const points = () => pair().marks.points;
const current = () => points()[selected];

const keeper = new Keeper({
  pointsOf: (which) => pairs[which].marks.points,
  kept: (which, problems) => {
    pairs[which].problems = problems;
    return keeper.unsent.size ? null : showWarped(which);
  },
  changed: () => render(),
});

let warpedAddress = null;

// Show A carried onto B, in B's picture and beside it; not while the points are impossible.
async function showWarped(which) {
  const { problems, marks } = pairs[which];
  const good = !problems.length && marks.points.length > 0;
  $("warped").classList.toggle("stale", !good);
  const found = good ? await keeper.warped(which) : null;
  pairs[which].folded = new Set(found?.folded);
  if (found && which === kind) {
    if (warpedAddress) URL.revokeObjectURL(warpedAddress);
    warpedAddress = found.address;
    views.b.overlay.setAttribute("href", warpedAddress);
    warped.picture.setAttribute("href", warpedAddress);
    $("warped").dataset.revision = keeper.revision;
  }
  render();
}

async function save(path = "save") {
  const done = await keeper.save(path);
  if (done) announce("saved");
  if (done && path === "finish") $("done").showModal();
  render();
}

// --- what a person does -----------------------------------------------------------------------

function changed() {
  selected = Math.min(selected, points().length - 1);
  keeper.send(kind);
  render();
}

function select(index, where = side) {
  pair().marks.endAction();
  side = where;
  selected = index;
  render();
  const point = current();
  if (!point) return;
  for (const s of SIDES) if (point[s]) views[s].reveal(point[s]);
  const at = point[side];
  announce(`${point.name} in ${NAME[side]}${at ? `: ${at.join(", ")}` : " is not marked"}${isUnpaired(point) ? ", unpaired" : ""}`);
}

function go(step) {
  const n = points().length;
  if (n) select(selected < 0 ? (step > 0 ? 0 : n - 1) : (selected + step + n) % n);
}

function moveBy(step, action, index = selected, where = side) {
  if (!points()[index]?.[where]) return;
  pair().marks.move(index, where, step, scope, pair().sizes[where], action);
  views[where].reveal(points()[index][where]);
  changed();
}

// A click while adding: the other half of the selected point, or a new point.
function place(at, where) {
  const inside = at.map((v, k) => rounded(Math.min(Math.max(v, 0), pair().sizes[where][k] - 1)));
  side = where;
  const point = current();
  if (point && !point[where]) pair().marks.set(selected, { [where]: inside });
  else selected = pair().marks.add(where, inside);
  changed();
}

function addInTheMiddle() {
  const { x, y } = views[side].look;
  selected = pair().marks.add(side, [rounded(x), rounded(y)]);
  changed();
  announce(`${current().name} added in ${NAME[side]}; move it, then pair it with P`);
}

function pairUp() {
  if (!current() || !isUnpaired(current())) return;
  side = current().a ? "b" : "a"; // the new one is what may have to be moved
  selected = pair().marks.pair(selected, pair().sizes);
  changed();
  announce(`${current().name} is paired`);
}

function remove() {
  if (!current()) return;
  announce(`${current().name} deleted`);
  pair().marks.remove(selected);
  changed();
}

function unpair() {
  if (!current()?.[side]) return;
  pair().marks.unpair(selected, side);
  changed();
}

function step(back) {
  if (back ? pair().marks.undo() : pair().marks.redo()) changed();
}

function zoom(factor) {
  for (const s of SIDES) views[s].zoom(factor, current()?.[s] ?? undefined);
}

function fit() {
  for (const s of SIDES) views[s].fit(points().map((p) => p[s]).filter(Boolean));
}

function setScope(value) {
  scope = value;
  document.querySelector(`#scope input[value=${value}]`).checked = true;
  announce(`moving: ${value}`);
}

function setAdding(value) {
  adding = value;
  if (adding) selected = -1;
  render();
}

function setMix(value) {
  $("mix").value = value;
  views.b.overlay.setAttribute("opacity", value / 100);
}

function showKind(next) {
  if (!pairs[next]) return;
  kind = next;
  selected = -1;
  for (const view of [views.b.overlay, warped.picture]) view.removeAttribute("href");
  for (const s of SIDES) {
    const about = pair()[s];
    views[s].show(`picture/${kind}/${s}`, about.size);
    const what = `${about.clip}, frame ${about.frame}`;
    document.querySelector(`#head-${s} .what`).textContent = what;
    $(`picture-${s}`).setAttribute("aria-label", `Picture ${NAME[s]}: ${what}`);
  }
  warped.show(null, pair().b.size);
  fit();
  render();
  showWarped(kind);
}

function announce(text) {
  $("announcer").textContent = text;
}

// --- what it looks like -----------------------------------------------------------------------

function render() {
  const { marks, folded } = pair();
  for (const s of SIDES) {
    views[s].draw(marks.points, selected, folded);
    views[s].svg.classList.toggle("adding", adding);
    views[s].svg.classList.toggle("current", side === s);
  }
  renderTabs();
  renderTools();
  renderMessages();
  renderPoint();
  renderList();
}

function renderTabs() {
  for (const tab of document.querySelectorAll("[role=tab]")) {
    const shown = pairs[tab.dataset.kind];
    tab.hidden = !shown;
    if (!shown) continue;
    tab.setAttribute("aria-selected", tab.dataset.kind === kind);
    tab.tabIndex = tab.dataset.kind === kind ? 0 : -1;
    tab.querySelector(".count").textContent = shown.marks.points.length;
    tab.classList.toggle("bad", shown.problems.length > 0);
  }
  $("work").setAttribute("aria-labelledby", `tab-${kind}`);
  $("work").setAttribute("aria-busy", keeper.sending !== null);
  $("saved").textContent = keeper.saved ? "All saved" : "Not saved yet";
  $("saved").classList.toggle("saved", keeper.saved);
}

function renderTools() {
  const { marks } = pair();
  $("undo").disabled = !marks.past.length;
  $("redo").disabled = !marks.future.length;
  $("add").setAttribute("aria-pressed", adding);
  $("pair").disabled = !current() || !isUnpaired(current());
  $("unpair").disabled = !current()?.[side];
  $("delete").disabled = !current();
}

function renderMessages() {
  const { problems, folded, marks } = pair();
  const shown = [];
  if (keeper.failure) shown.push(message("bad", keeper.failure));
  for (const problem of problems.slice(0, 3)) {
    const index = marks.points.findIndex((p) => p.name === problem.point);
    shown.push(message("bad", problem.text, index));
  }
  if (problems.length > 3) shown.push(message("bad", `and ${problems.length - 3} more`));
  if (folded.size) {
    const index = marks.points.findIndex((p) => folded.has(p.name));
    const few = [...folded].slice(0, 4).join(", ") + (folded.size > 4 ? ", ..." : "");
    shown.push(message("warn", `The map folds over near ${few}: points have crossed`, index));
  }
  if (adding) shown.push(message("hint", "Click the same spot in A and in B; Escape ends adding."));
  else if (!shown.length) shown.push(message("hint", "Drag every point to the same spot of both faces. Keys: ?"));
  $("messages").replaceChildren(...shown);
}

function message(kindOf, text, index = -1) {
  const line = document.createElement("p");
  line.className = kindOf;
  line.textContent = text;
  if (index >= 0) {
    const button = document.createElement("button");
    button.textContent = "Show";
    button.addEventListener("click", () => select(index, points()[index][side] ? side : other(side)));
    line.append(button);
  }
  return line;
}

function renderPoint() {
  const point = current();
  const set = (id, value) => {
    $(id).disabled = !point;
    if (document.activeElement !== $(id)) $(id).value = value ?? "";
  };
  set("name", point?.name);
  for (const s of SIDES) ["x", "y"].forEach((axis, k) => set(s + axis, point?.[s]?.[k]));
}

function renderList() {
  const { marks, folded } = pair();
  const rows = marks.points.map((point, i) => {
    const row = document.createElement("li");
    const note = isUnpaired(point) ? `only in ${NAME[point.a ? "a" : "b"]}` : folded.has(point.name) ? "folds" : "";
    row.id = `row-${i}`;
    row.dataset.index = i;
    row.setAttribute("role", "option");
    row.setAttribute("aria-selected", i === selected);
    row.className = groupClass(point.name);
    row.classList.toggle("unpaired", isUnpaired(point));
    row.classList.toggle("folded", folded.has(point.name));
    row.append(point.name);
    const said = document.createElement("span");
    said.className = "note";
    said.textContent = note;
    row.append(said);
    return row;
  });
  $("list").replaceChildren(...rows);
  $("list").setAttribute("aria-activedescendant", selected >= 0 ? `row-${selected}` : "");
  rows[selected]?.scrollIntoView({ block: "nearest" });
}

// --- keys and buttons -------------------------------------------------------------------------

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEYS = {
  "[": () => go(-1), "]": () => go(1), n: addInTheMiddle, p: pairUp, u: () => step(true), r: () => step(false),
  x: () => select(selected, other(side)), m: () => setScope({ point: "group", group: "all", all: "point" }[scope]),
  "+": () => zoom(ZOOM), "=": () => zoom(ZOOM), "-": () => zoom(1 / ZOOM), 0: fit, s: () => save(),
  w: () => SIDES.forEach((s) => views[s].whole()), h: () => setMix($("mix").value > 50 ? 0 : 100),
  l: () => $("labels").click(), 1: () => showKind("closed"), 2: () => showKind("open"),
  "?": () => $("help").showModal(), Delete: remove, Backspace: remove,
  Escape: () => { setAdding(false); select(-1); },
};
const CONTROL_KEYS = { z: () => step(true), y: () => step(false), Z: () => step(false), s: () => save() };

document.addEventListener("keydown", (event) => {
  if (document.querySelector("dialog[open]") || event.altKey) return;
  const typing = event.target.matches("input:not([type=checkbox])");
  const control = event.ctrlKey || event.metaKey;
  const key = event.key.length === 1 && !control ? event.key.toLowerCase() : event.key;
  if (typing && !(control && event.key === "s")) return;
  if (ARROWS[event.key]) {
    if (!arrow(event)) return;
  } else if (control) {
    if (!CONTROL_KEYS[key]) return;
    CONTROL_KEYS[key]();
  } else if (key === "Delete" && event.shiftKey) unpair();
  else if (KEYS[key]) KEYS[key]();
  else return;
  event.preventDefault();
});

// An arrow key in a picture moves the point or the view, in the list the selection.
function arrow(event) {
  const [right, down] = ARROWS[event.key];
  if (event.target === $("list")) {
    if (down) go(down);
    return down !== 0;
  }
  if (event.target.matches("[role=tab]")) {
    showKind(kind === "closed" ? "open" : "closed");
    $(`tab-${kind}`).focus();
    return true;
  }
  if (!current()) views[side].pan(0.1 * right, 0.1 * down);
  else {
    const size = event.shiftKey ? STEP.fine : event.ctrlKey || event.metaKey ? STEP.coarse : STEP.plain;
    moveBy([size * right, size * down], `keys ${side} ${selected}`);
  }
  return true;
}

for (const s of SIDES) {
  $(`picture-${s}`).addEventListener("focus", () => {
    side = s;
    render();
  });
  ["x", "y"].forEach((axis) => $(s + axis).addEventListener("change", () => {
    const at = ["x", "y"].map((name) => $(s + name).valueAsNumber);
    if (!current() || at.some(Number.isNaN)) return;
    const size = pair().sizes[s];
    pair().marks.set(selected, { [s]: at.map((v, k) => rounded(Math.min(Math.max(v, 0), size[k] - 1))) });
    changed();
  }));
}
$("name").addEventListener("change", () => {
  if (!current() || !$("name").value.trim()) return render();
  pair().marks.set(selected, { name: $("name").value.trim() });
  changed();
});
$("point").addEventListener("submit", (event) => event.preventDefault());
$("list").addEventListener("click", (event) => {
  const row = event.target.closest("li");
  if (!row) return;
  select(Number(row.dataset.index));
  $(`picture-${side}`).focus(); // so that the arrow keys move the point
});
$("list").addEventListener("keydown", (event) => {
  if (event.key === "Enter") $(`picture-${side}`).focus();
});
$("scope").addEventListener("change", (event) => setScope(event.target.value));
$("labels").addEventListener("change", () => document.body.classList.toggle("named", $("labels").checked));
$("mix").addEventListener("input", () => setMix($("mix").value));
for (const tab of document.querySelectorAll("[role=tab]")) {
  tab.addEventListener("click", () => showKind(tab.dataset.kind));
}
const BUTTONS = {
  undo: () => step(true), redo: () => step(false), add: () => setAdding(!adding), pair: pairUp, unpair, delete: remove,
  reset: () => { pair().marks.become(pair().proposal); changed(); },
  "zoom-in": () => zoom(ZOOM), "zoom-out": () => zoom(1 / ZOOM), fit, whole: KEYS.w,
  save: () => save(), finish: () => save("finish"),
  "help-button": KEYS["?"], "help-close": () => $("help").close(),
};
for (const [id, action] of Object.entries(BUTTONS)) $(id).addEventListener("click", action);

// --- begin ------------------------------------------------------------------------------------

const state = await keeper.begin();
for (const { kind: name, points: given, ...about } of state.pairs) {
  const sizes = { a: about.a.size, b: about.b.size };
  pairs[name] = { ...about, sizes, marks: new Marks(given), folded: new Set() };
}
$("done-file").textContent = state.out;
document.title = `${state.out} - mark corresponding points`;
showKind("closed");
document.body.dataset.ready = "yes";
