// Plays the drives of a case side by side: bird's eye and station-time graph.
// Data: the JSON of `report.player`: replays, each drive with its `look`, and colours.
// `report.pages` puts drawing.js, this file and cases.js into one strict function.
const at = (id) => document.getElementById(id);
const root = at("player");
if (!root) return tables();
const { cases, colours } = JSON.parse(at("replays").textContent);

let current = null; // the case
let panels = []; // one per drive: its elements
let time = 0; // s
let playing = false;
const BEFORE_S = 3; // s before the drives part at which a case opens
let before = null; // timestamp of the last animation frame

// ------------------------------------------------------------------ page

function words(drive, now) {
  if (time >= endOf(drive) - 1e-6 && drive.end) return `${drive.end}.`;
  const gap = now.clearance === null ? "nobody near" : `clearance ${now.clearance.toFixed(1)} m`;
  return `speed ${now.v.toFixed(1)} m/s, acceleration ${now.a.toFixed(1)} m/s², ${gap}`;
}

function render() {
  const scrub = at("scrub");
  scrub.value = time;
  const clock = `${time.toFixed(1)} s of ${Number(scrub.max).toFixed(1)} s`;
  at("clock").textContent = `${current.case}: ${clock}`;
  scrub.setAttribute("aria-valuetext", clock);
  for (const panel of panels) {
    const now = birdsEye(panel.bird, panel.drive);
    stationTime(panel.graph, panel.drive, now);
    const said = words(panel.drive, now);
    panel.now.textContent = said;
    if (!playing) {
      panel.bird.setAttribute("aria-label", `Bird's eye view of ${panel.drive.row}: ${said}`);
      panel.graph.setAttribute("aria-label",
        `Station-time graph of ${panel.drive.row} at ${clock}`);
    }
  }
}

function element(parent, tag, content, name) {
  const made = document.createElement(tag);
  if (content) made.textContent = content;
  if (name) made.className = name;
  parent.appendChild(made);
  return made;
}

function swatch(parent, look) {
  const made = element(parent, "canvas");
  Object.assign(made, { width: 34, height: 10 });
  made.setAttribute("aria-hidden", "true");
  line(made.getContext("2d"), [[0, 5], [34, 5]], look.colour, 3, look.dash);
}

function panelOf(drive) {
  const part = element(at("drives"), "div", "", "drive");
  const heading = element(part, "h4");
  swatch(heading, drive.look);
  element(heading, "span", ` ${drive.row}`);
  element(part, "p", drive.summary + (drive.end ? `; ${drive.end}` : ""), "note");
  const now = element(part, "p");
  const views = element(part, "div", "", "views");
  const [bird, graph] = ["canvas", "canvas"].map((tag) => element(views, tag));
  for (const canvas of [bird, graph]) canvas.setAttribute("role", "img");
  return { drive, now, bird, graph };
}

function seek(t) {
  const scrub = at("scrub");
  time = Math.min(Math.max(t, current.frame_s), Number(scrub.max));
  render();
}

// The first frame that is not before t.
function seekFrame(t) {
  seek(Math.ceil(t / current.frame_s - 1e-6) * current.frame_s);
}

function show(number) {
  current = cases[number];
  at("case").value = String(number);
  at("drives").replaceChildren();
  at("events").replaceChildren();
  panels = current.drives.map(panelOf);
  const scrub = at("scrub");
  scrub.min = current.frame_s;
  scrub.step = current.frame_s;
  scrub.max = Math.max(...current.drives.map(endOf));
  const drawn = Object.entries(current.parameters).map(([name, v]) => `${name} ${v}`);
  at("parameters").textContent = drawn.join(", ");
  for (const drive of current.drives) {
    for (const [t, what] of drive.events) {
      const button = element(at("events"), "button", `${t.toFixed(1)} s ${drive.row}: ${what}`);
      button.type = "button";
      button.addEventListener("click", () => { play(false); seekFrame(t); });
    }
  }
  play(false);
  const faults = current.drives.filter((drive) => drive.end);
  const look = (faults[0] || current.drives[0]).start;
  seekFrame(Math.min(look, current.apart === null ? look : current.apart) - BEFORE_S);
}

function tick(stamp) {
  if (!playing) return;
  if (before !== null) {
    time += Math.min((stamp - before) / 1000, 0.25) * Number(at("speed").value);
  }
  before = stamp;
  const end = Number(at("scrub").max);
  if (time >= end) {
    time = end;
    play(false);
  } else {
    requestAnimationFrame(tick);
  }
  render();
}

function play(on) {
  playing = on;
  before = null;
  at("play").textContent = on ? "Pause" : "Play";
  at("play").setAttribute("aria-pressed", String(on));
  if (!on) return;
  if (time >= Number(at("scrub").max) - 1e-6) time = current.frame_s;
  requestAnimationFrame(tick);
}

function toggle() {
  play(!playing);
  if (!playing) render();
}

function stepBy(count) {
  play(false);
  seek((Math.round(time / current.frame_s) + count) * current.frame_s);
}

const KEYS = {
  " ": toggle,
  ArrowLeft: () => stepBy(-1),
  ArrowRight: () => stepBy(1),
  Home: () => stepBy(-1e6),
  End: () => stepBy(1e6),
};

root.addEventListener("keydown", (event) => {
  const within = event.target.tagName;
  const own = within === "SELECT" || (event.key === " " && (within === "BUTTON" || within === "SUMMARY"));
  if (!(event.key in KEYS) || own || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  KEYS[event.key]();
});
at("play").addEventListener("click", toggle);
at("back").addEventListener("click", () => stepBy(-1));
at("forward").addEventListener("click", () => stepBy(1));
at("scrub").addEventListener("input", (event) => {
  play(false);
  seek(Number(event.target.value));
});
at("case").addEventListener("change", (event) => show(Number(event.target.value)));
for (const link of document.querySelectorAll("a[data-case]")) {
  link.addEventListener("click", () => {
    show(Number(link.dataset.case));
    root.focus({ preventScroll: true });
  });
}
window.addEventListener("resize", () => { if (!playing) render(); });
window.addEventListener("beforeprint", () => { play(false); render(); });
show(0);
tables();
