// Shows one pair after the other, each clip at least once to its end, and sends what is chosen.
// The server says which pair is next and keeps the answers; nothing is kept here.

const RETRY_MS = 1500; // until an answer that did not arrive is sent again
const SIDES = ["left", "right"];
const LETTER = { left: "A", right: "B" };
const KEYS = { ArrowLeft: "left", ArrowDown: "undecided", ArrowRight: "right" };

const find = (selector) => document.querySelector(selector);
const figures = Object.fromEntries(SIDES.map((side) => [side, find(`figure[data-side=${side}]`)]));
const video = (side) => figures[side].querySelector("video");
const radios = [...document.querySelectorAll("input[name=choice]")];

const study = { pairs: 0, answered: 0 };
const seen = new Set(); // sides of this pair that were played to their end
let following = false; // whether the right clip plays when the left one has ended
let playings = 0; // how many were begun
let sending = false;

function show(screen) {
  document.body.dataset.screen = screen;
  find("#progress").max = Math.max(study.pairs, 1);
  find("#progress").value = study.answered;
}

function say(text, again = null) {
  find("#message").hidden = !text;
  find("#message span").textContent = text;
  find("#again").hidden = !again;
  find("#again").onclick = again;
}

// ---- the server's side ----------------------------------------------------------------------

// What the server answers, or null where it cannot be reached at the moment.
async function ask(path, body = null) {
  const options = body && { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  try {
    const answer = await fetch(path, options ?? {});
    if (answer.status >= 500) return null;
    return { status: answer.status, ...(await answer.json()) };
  } catch {
    return null;
  }
}

async function askUntilAnswered(path, body, waiting) {
  for (;;) {
    const answer = await ask(path, body);
    if (answer) return answer;
    say(waiting);
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
  }
}

async function load() {
  const state = await askUntilAnswered("state", null, "The study cannot be reached. Trying again …");
  if (state.error) return say(`${state.error}.`);
  Object.assign(study, state);
  say("");
  if (study.answered >= study.pairs) return finish();
  find("#introduction").textContent = study.introduction;
  const left = study.pairs - study.answered;
  find("#length").textContent = study.answered
    ? `You have answered ${study.answered} of ${study.pairs} pairs.`
    : `There ${left === 1 ? "is one pair" : `are ${left} pairs`}.`;
  find("#begin").textContent = study.answered ? "Continue" : "Begin";
  show("intro");
}

async function send(choice) {
  sending = true;
  enable();
  const pair = study.answered + 1;
  const waiting = "The study cannot be reached. Your answer is kept here and sent again …";
  const answer = await askUntilAnswered(`pairs/${pair}/answer`, { choice }, waiting);
  sending = false;
  if (answer.answered === undefined) {
    enable();
    return say(`The answer was not taken: ${answer.error}.`);
  }
  study.answered = answer.answered;
  say(answer.error ? `Not counted: ${answer.error}.` : "");
  if (study.answered >= study.pairs) return finish();
  showPair();
}

// ---- a pair ---------------------------------------------------------------------------------

function showPair() {
  const pair = study.answered + 1;
  seen.clear();
  for (const radio of radios) radio.checked = false;
  find("#place").textContent = `Pair ${pair} of ${study.pairs}`;
  document.body.dataset.pair = pair;
  show("pair");
  for (const side of SIDES) {
    mark(side, "");
    video(side).src = `pairs/${pair}/${side}.mp4`;
  }
  enable();
  window.scrollTo(0, 0);
  play("left", { inTurn: true });
}

// Play one side from its beginning, the other one silent; inTurn: and the right after the left.
async function play(side, { inTurn = false } = {}) {
  for (const other of SIDES) if (other !== side) stop(other);
  following = inTurn && side === "left";
  const own = ++playings;
  mark(side, "playing");
  video(side).currentTime = 0;
  try {
    await video(side).play();
  } catch {
    if (own === playings) stop(side); // it does not load: said elsewhere; else another was begun
  }
}

function stop(side) {
  video(side).pause();
  mark(side, seen.has(side) ? "seen" : "");
}

function ended(side) {
  seen.add(side);
  mark(side, "seen");
  enable();
  if (following) play("right");
}

function mark(side, state) {
  figures[side].dataset.state = state;
  figures[side].querySelector(".state").textContent = state;
}

function enable() {
  const both = seen.size === SIDES.length;
  const chosen = radios.some((radio) => radio.checked);
  find("#choices").disabled = !both || sending;
  find("#confirm").disabled = !both || !chosen || sending;
  const missing = SIDES.filter((side) => !seen.has(side)).map((side) => LETTER[side]);
  find("#hint").textContent = both
    ? "Which one is real?"
    : `Watch ${missing.join(" and ")} to the end, then choose.`;
}

function fail() {
  say("A clip could not be loaded.", () => {
    say("");
    for (const side of SIDES) video(side).load();
    play("left", { inTurn: true });
  });
}

function finish() {
  for (const side of SIDES) video(side).removeAttribute("src");
  show("done");
  find("#done-title").focus();
}

// ---- what the participant does --------------------------------------------------------------

find("#begin").addEventListener("click", showPair);
find("#pair").addEventListener("submit", (event) => {
  event.preventDefault();
  const choice = radios.find((radio) => radio.checked)?.value;
  if (choice && !sending && seen.size === SIDES.length) send(choice);
});
find("#choices").addEventListener("change", enable);
for (const side of SIDES) {
  const clip = video(side);
  clip.addEventListener("click", () => play(side));
  clip.addEventListener("ended", () => ended(side));
  clip.addEventListener("error", () => clip.getAttribute("src") && fail());
  clip.addEventListener("loadedmetadata", () => {
    figures[side].style.setProperty("--shape", `${clip.videoWidth} / ${clip.videoHeight}`);
  });
  figures[side].querySelector("button").addEventListener("click", () => play(side));
}
document.addEventListener("keydown", (event) => {
  if (document.body.dataset.screen !== "pair" || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "1" || event.key === "2") return play(SIDES[Number(event.key) - 1]);
  const radio = radios.find((r) => r.value === KEYS[event.key]);
  if (!radio || find("#choices").disabled) return;
  event.preventDefault();
  radio.checked = true;
  radio.focus();
  enable();
});
// a page that comes back from the browser's memory knows only what was true when it was left
window.addEventListener("pageshow", (event) => event.persisted && window.location.reload());

load();
