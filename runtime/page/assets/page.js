// Script for the operator's page: polls the daemon, draws its state and posts commands. Data is loaded only from the
// server that delivered the page.
import { drawPlan } from "/display.js";
import { Choice, MORE, effortInWords, modelsOf, scenesOf } from "/choice.js";
import { ask, keep, token } from "/session.js";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const KEPT = 240; // number of points in a plot, which covers two minutes
const LEAST_PLOTTED = 20; // a plot covers at least this many steps
const OLD_S = 1; // pictures older than this are dimmed
const STATUS_MS = 500, PICTURES_MS = 400, LOG_MS = 1000, ABOUT_MS = 5000, RETRY_MS = 1000;
const ZOOMED_SIGMAS = 20; // radius of the drawn uncertainty: two standard deviations, enlarged ten times

const CHOICES = {
  scene: new Choice($("scene"), $("scene-file"), { box: $("scene-file").parentElement.parentElement, text: "another file or folder …" }),
  model: new Choice($("model"), $("model-file"), { box: $("model-file").parentElement.parentElement, text: "an ONNX file …" }),
};
$("more").innerHTML = MORE;

let about = null;
let running = false;

function element(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  return made;
}

function html(name, text = "", data = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  Object.assign(made.dataset, data);
  return made;
}

function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// A solution's age, or 0 if it was computed for a time after the display time.
const age = (value) => (typeof value === "number" ? Math.max(0, value) : value);
const number = (value, digits = 1) => (value === null || value === undefined ? "–" : Number(value).toFixed(digits));
const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString([], { hour12: false });

// Plots.

const PLOTS = [
  ["refreshes/s", (s) => s.fps_now, 1],
  ["solutions/s", (s) => s.solutions_per_s_now, 1],
  ["solution age, ms", (s) => age(s.solution_age_now_ms), 1, "Time since the picture was computed."],
  ["view error (estimated), mm", (s) => s.view_error_estimated_now_mm, 1, "How far the eyes are from where the picture is correct."],
  ["capture to light, ms", (s) => s.photon_now_ms, 1],
  ["uncertainty of the eyes, mm", (s) => s.eye_sigma_now_mm, 2],
  ["presenting (median), ms", (s) => s.stage_ms?.present?.p50, 2],
].map(([title, value, digits, meaning]) => {
  const box = html("div");
  box.className = "plot";
  const line = html("p");
  const shown = document.createElement("output");
  line.append(html("span", title), shown);
  const svg = element("svg", { viewBox: `0 0 ${KEPT} 56`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const curve = element("path");
  svg.append(curve);
  const axis = html("div"), [most, least] = ["most", "least"].map((name) => Object.assign(html("span"), { className: name }));
  axis.className = "axis";
  axis.append(svg, most, least);
  box.append(line, axis);
  if (meaning) box.append(Object.assign(html("p", meaning), { className: "key" }));
  $("plots").append(box);
  return { value, digits, shown, curve, most, least, values: [] };
});

function plot(status) {
  for (const p of PLOTS) {
    const value = status ? p.value(status) : null;
    p.values.push(typeof value === "number" ? value : null);
    if (p.values.length > KEPT) p.values.shift();
    setText(p.shown, number(value, p.digits));
    const known = p.values.filter((v) => v !== null);
    const most = Math.max(1e-9, ...known) * 1.1;
    const least = Math.min(0, ...known);
    const step = KEPT / Math.max(p.values.length - 1, LEAST_PLOTTED); // the curve fills the plot
    setText(p.most, known.length ? number(most, p.digits) : "");
    setText(p.least, known.length ? number(least, p.digits) : "");
    const height = (v) => (54 - (52 * (v - least)) / (most - least)).toFixed(1);
    // Leave a gap in the curve where a value is unknown.
    const steps = p.values.map((v, i) => v === null ? "" : `${i && p.values[i - 1] !== null ? "L" : "M"}${(i * step).toFixed(1)},${height(v)}`);
    p.curve.setAttribute("d", steps.join(""));
  }
  const span_s = (Math.max(PLOTS[0].values.length - 1, LEAST_PLOTTED) * STATUS_MS) / 1000;
  setText($("plots-span"), `from left to right: the last ${number(span_s, 0)} seconds`);
}

// Plans of the eyes and panels, seen from above and from the side.

function view(svg, status, axis, range) {
  const sigma_m = ((status.eye_sigma_now_mm ?? 0) / 1000) * ZOOMED_SIGMAS;
  drawPlan(svg, { stack: about.stack, eyes: status.people?.length ? status.people.flatMap((person) => person.eyes_m) : status.eyes_m, axis, range, sigma_m, far_m: Math.max(1.0, 1.15 * (about.viewing_m?.[1] ?? 0.6)) });
}

function sector(low_deg, high_deg) {
  const [near, far] = about.viewing_m;
  const angles = Array.from({ length: 9 }, (_, k) => ((low_deg + ((high_deg - low_deg) * k) / 8) * Math.PI) / 180);
  const arc = (r) => angles.map((a) => [r * Math.cos(a), r * Math.sin(a)]);
  return [...arc(near), ...arc(far).reverse()];
}

function drawEyes(status) {
  const told = status.eyes_m
    ? status.eyes_m.map((eye, i) => `${i ? "right" : "left"} (${eye.map((v) => v.toFixed(3)).join(", ")}) m`).join(", ") +
      ` – ${status.eyes_label}, ± ${number(status.eye_sigma_now_mm, 2)} mm`
    : "no viewer";
  setText($("eyes-told"), told);
  if (!about?.stack) return;
  const side = about.viewing_side_deg;
  view($("above"), status, 1, sector(-side, side));
  view($("side"), status, 2, sector(...about.viewing_up_deg));
}

// Figures, savings and faults.

function figures(status) {
  const rows = {
    scene: status.scene === status.content ? status.scene : `${status.scene} (${status.content})`,
    model: `${status.model} on ${status.provider}`,
    panels: status.panels,
    "uptime": `${Math.floor(status.uptime_s / 3600)} h ${Math.floor((status.uptime_s % 3600) / 60)} min`,
    refreshes: `${status.presented} presented, ${status.dropped} dropped, ${status.missed_blanks} missed blanks`,
    solutions: `${status.inferences}`,
    people: `${status.people_in_view ?? 0} in view, served: ${(status.people ?? []).map((person) => `person ${person.number}`).join(" and ") || "none"}`,
    sensor: `${number(status.sensor_hz)} samples/s, ${status.stale_inputs} skipped`,
    "capture to light": status.photon_ms ? `${number(status.photon_ms.p50)} ms (p50), ${number(status.photon_ms.p99)} (p99)` : "–",
    "solution age": status.solution_age_ms ? `${number(age(status.solution_age_ms.p50))} ms (p50), ${number(age(status.solution_age_ms.p99))} (p99)` : "–",
    effort: status.effort ? effortInWords(status.effort) : "–",
    "view error, estimated": status.view_error_estimated_mm ? `${number(status.view_error_estimated_mm.p50)} mm (p50), ${number(status.view_error_estimated_mm.p95)} (p95)` : "–",
    ...(status.view_error_mm ? { "view error": `${number(status.view_error_mm.p50)} mm (p50), ${number(status.view_error_mm.p95)} (p95)` } : {}),
    ...(typeof status.live_db === "number" ? { "live quality": `${number(status.live_db)} dB at the true eyes` } : {}),
    "stages, median (and p99)": Object.entries(status.stage_ms ?? {}).filter(([, v]) => v)
      .map(([k, v]) => `${k}: ${number(v.p50, 2)} ms (${number(v.p99, 2)} ms)`).join("\n") || "–",
    "black box": status.blackbox ? `${number(status.blackbox.kept_s, 0)} s kept, ${number(status.blackbox.kept_mib)} MiB; last file: ${status.blackbox.last_file ?? "none"}` : "–",
  };
  if (status.loading) rows.loading = status.loading;
  if (status.refused) rows.refused = status.refused;
  const list = $("numbers");
  if (list.children.length !== 2 * Object.keys(rows).length) {
    list.replaceChildren(...Object.keys(rows).flatMap((name) => [html("dt", name), Object.assign(html("dd"), { className: name.startsWith("stages") ? "stages" : "" })]));
  }
  Object.entries(rows).forEach(([name, text], i) => {
    setText(list.children[2 * i], name);
    setText(list.children[2 * i + 1], text);
  });
}

function leftOut(status) {
  const key = JSON.stringify(status.plan);
  if ($("plan").dataset.key !== key) {
    $("plan").dataset.key = key;
    // Modules that were not imported save nothing while the display runs.
    $("plan").replaceChildren(...(status.plan ?? []).filter((item) => item.what !== "optional parts").map((item) => {
      const row = html("tr");
      row.append(html("td", item.what), html("td", item.why),
        html("td", item.saves_ms === null ? "not measured" : `${number(item.saves_ms)} ms`),
        html("td", item.costs_db === null ? "not measured" : `${number(item.costs_db, 2)} dB`));
      return row;
    }));
  }
  const faults = Object.entries(status.faults ?? {}).map(([part, count]) => `${part} ${count}`).join(", ");
  setText($("faults"), faults ? `faults since startup: ${faults}` : "no faults since startup");
}

function entries(list, items, made) {
  const newest = [...items].reverse();
  const key = JSON.stringify(newest);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...newest.map((item) => {
    const [text, data] = made(item);
    const line = html("li", "", data);
    line.append(html("time", clock(item.time_s)), text);
    return line;
  }));
}

// Pictures.

const PLACES = (number, count) => number === 0 ? " (rear)" : number === count - 1 ? " (front)" : count === 3 ? " (middle)" : "";
const NAMED = (name, count) => name.startsWith("layer-") ? `panel ${name.slice(6)}${PLACES(Number(name.slice(6)), count)}` :
  name === "seen-left" ? "seen by the left eye" : "seen by the right eye";

// Position of an eye, as seen by the viewer.
function placeOf([out, right]) {
  const cm = (value) => `${Math.abs(100 * value).toFixed(0)} cm`;
  return `${cm(out)} away, ${cm(right)} to the ${right < 0 ? "left" : "right"}`;
}

function pictures(answer) {
  const box = $("pictures");
  const names = Object.keys(answer.jpegs ?? {}).sort();
  const count = names.filter((name) => name.startsWith("layer-")).length;
  const eyes = ["seen-left", "seen-right"].filter((name) => !names.includes(name));
  for (const name of [...names, ...eyes]) {
    let figure = box.querySelector(`[data-name="${name}"]`);
    if (!figure) {
      figure = html("figure", "", { name });
      const image = document.createElement("img");
      image.alt = NAMED(name, count);
      image.hidden = true;
      figure.append(image, html("figcaption"));
      box.append(figure);
      [...box.children].sort((a, b) => a.dataset.name.localeCompare(b.dataset.name)).forEach((f) => box.append(f));
    }
    const [image, caption] = figure.children;
    const data = answer.jpegs?.[name];
    image.hidden = false;
    if (data) image.src = `data:image/jpeg;base64,${data}`;
    const eye_m = answer.eyes_m?.[name === "seen-left" ? 0 : 1];
    const seen = name.startsWith("seen-") && eye_m ? `, ${placeOf(eye_m)}` : "";
    setText(caption, NAMED(name, count) + (data ? seen : ": no viewer"));
  }
  box.dataset.frame = answer.frame ?? "";
  pictured = { time_s: answer.time_s, state: answer.state, arrived_ms: performance.now() };
  pictureTime();
}

// The pictures' time and state. Pictures that are old or of another state than the one shown are dimmed.
let pictured = null;

function pictureTime() {
  if (!pictured?.time_s) return;
  const age_s = (performance.now() - pictured.arrived_ms) / 1000, old = age_s > OLD_S || !running;
  $("pictures").parentElement.toggleAttribute("data-old", old);
  setText($("pictures-when"), `${clock(pictured.time_s)}, ${pictured.state}${old ? `, ${number(age_s, 0)} s ago` : ""}`);
}

async function lookAtPictures() {
  const answer = await lookUp("pictures");
  if (answer.ok) pictures(answer);
  pictureTime();
}

// Scenes.

const short = (name) => name.split("/").filter(Boolean).pop() ?? name;

function playlist(told) {
  const left = told?.left_s === null || told?.left_s === undefined ? "no time limit" : `${number(told.left_s, 0)} s left`;
  setText($("list-told"), told ? `Playlist: ${told.index + 1} of ${told.entries.length} (${short(told.entries[told.index].scene)}), ${left}` : "");
  $("next").hidden = !told;
}

// The scene's placement, sent after every change.

const PLACE = [
  ["p-scale", "scale", null, 1], ["p-turntable", "turntable_per_min", null, 1],
  ["p-out", "offset_m", 0, 1000], ["p-right", "offset_m", 1, 1000], ["p-up", "offset_m", 2, 1000],
  ["p-roll", "rotation_deg", 0, 1], ["p-pitch", "rotation_deg", 1, 1], ["p-yaw", "rotation_deg", 2, 1],
  ["p-convergence", "convergence_m", null, 1000], ["p-comfort", "comfort_deg", null, 1],
];
let placed = null, waiting = null, sending = false;

function placing(told) {
  if (!told) return;
  placed = told;
  for (const [id, name, part, units] of PLACE) {
    const value = (part === null ? told[name] : told[name][part]) * units;
    // Do not overwrite a value that is being typed or has not been sent yet.
    if (document.activeElement !== $(id) && !waiting && !sending) $(id).value = Number(value.toFixed(4));
  }
}

async function sendPlacing() {
  if (sending || !waiting) return;
  sending = true;
  const value = waiting;
  waiting = null;
  await tell(null, "place", value, $("placed"));
  sending = false;
  sendPlacing();
}

for (const [id, name, part, units] of PLACE) {
  $(id).addEventListener("change", () => {
    if (!placed || $(id).validity.valueMissing || ($(id).value === "" && $(id).validity.valid)) return;
    if (!$(id).checkValidity()) {
      const { min, max, labels: [{ textContent: label }] } = $(id);
      $("placed").dataset.kind = "bad";
      return setText($("placed"), `${label}: must be a number from ${min} to ${max}`);
    }
    const value = Number($(id).value) / units;
    const before = (waiting ?? {})[name] ?? placed[name];
    const next = part === null ? value : before.map((v, k) => (k === part ? value : v));
    waiting = { ...waiting, [name]: next };
    placed = { ...placed, [name]: next };
    sendPlacing();
  });
}
$("place-form").addEventListener("submit", (event) => event.preventDefault());
$("place-reset").addEventListener("click", () => tell($("place-reset"), "place", null, $("placed")));

// Polling.

let loggedIn = Promise.resolve(); // resolved once the user has entered a token

function logIn() {
  if ($("login").open) return;
  $("refused").hidden = token() === "";
  $("token").value = "";
  $("login").showModal();
  loggedIn = new Promise((done) => $("login").addEventListener("close", done, { once: true }));
}
$("login").addEventListener("cancel", (event) => event.preventDefault());
$("login").querySelector("form").addEventListener("submit", (event) => {
  event.preventDefault();
  keep($("token").value.trim());
  $("login").close();
});

async function lookUp(name) {
  await loggedIn;
  const answer = await ask(`/now/${name}`);
  if (answer.status !== 401) return answer.json();
  logIn();
  return lookUp(name);
}

// Health.

let faultSince_s = null, pending = null, loadingSince_ms = null, refusedBefore = false;

function health(status) {
  const reason = status.reason ?? "", [state, part] = (status.state ?? "starting").split(": ");
  const fault = state === "degraded";
  faultSince_s = fault ? faultSince_s ?? Date.now() / 1000 : null;
  if (fault) return `Fault since ${clock(faultSince_s).slice(0, 5)}: ${reason.replace(`${part}: `, "")}; it repairs itself`;
  if (status.paused) return "Paused by you";
  if (status.flat_asked) return "Flat, as requested by you";
  const [first, ...remarks] = reason.split("; ");
  const well = { "eyes seen": "All is well", "no viewer": "All is well: nobody is in front of the display",
    "eyes lost": "All is well: eyes out of sight for a moment" }[first];
  const rest = remarks.filter((remark) => !remark.startsWith("keeping the last"));
  return well && !rest.length ? well : well ? rest.join("; ") : `${state}: ${reason}`;
}

// While a scene or model is loading, say so next to the control, with the time since it began.
function tellLoading({ loading }) {
  loadingSince_ms = loading === undefined ? null : loadingSince_ms ?? performance.now();
  const where = pending ?? $("scene-told");
  if (loading !== undefined) {
    where.dataset.kind = "loading";
    setText(where, `${loading || "loading"} … ${number((performance.now() - loadingSince_ms) / 1000, 0)} s`);
  } else if (!pending && where.dataset.kind === "loading") {
    where.dataset.kind = "";
    setText(where, "");
  }
}

function clearErrors() {
  for (const told of document.querySelectorAll('[data-kind="bad"]')) {
    told.dataset.kind = "";
    setText(told, "");
  }
}

function allow(controls) {
  for (const control of document.querySelectorAll("main :is(button, input, select)")) control.disabled = !controls;
}

const START = "To start the display, run: sudo systemctl start phasestack (or, by hand: phasestack run)";

function gone(why, hangs = false) {
  running = false;
  $("gone").hidden = false;
  setText($("gone"), hangs === null ? why : hangs ? `The daemon is not responding: ${why}` : `No daemon is running: ${why}. ${START}`);
  allow(false);
  for (const name of ["pause", "flat"]) document.querySelector(`[data-command=${name}]`).setAttribute("aria-pressed", "false");
  setText($("state"), hangs ? "not responding" : hangs === null ? "no connection" : "no daemon");
  $("state").dataset.state = "gone";
  document.body.dataset.known = "last";
  setText($("reason"), "");
  setText($("eyes-told"), "unknown");
  $("above").replaceChildren();
  $("side").replaceChildren();
  plot(null);
}

function show(status) {
  if (!running) allow(true);
  if (!running || (refusedBefore && !status.refused)) clearErrors(); // the daemon was missing or a later change succeeded
  refusedBefore = Boolean(status.refused);
  running = true;
  document.body.dataset.known = "now";
  const hangs = status.turn_age_s > 5;
  $("gone").hidden = !hangs;
  if (hangs) setText($("gone"), `The display loop has not responded for ${number(status.turn_age_s, 0)} s. See the log: journalctl -u phasestack`);
  const stopped = (status.paused || status.flat_asked) && !status.state?.startsWith("degraded"); // by the operator
  const reason = status.reason ?? "", late = /solutions take|has not answered for/.test(reason);
  setText($("state"), hangs ? "not responding" : late ? "late" : stopped ? (status.paused ? "paused" : "flat") : status.state ?? "starting");
  $("state").dataset.state = hangs ? "gone" : late ? "late" : stopped ? "paused" : (status.state ?? "starting").split(":")[0];
  if (pictured && status.state !== pictured.state) lookAtPictures();
  setText($("reason"), hangs ? "" : late ? `${reason}; use ${status.model === "fast" ? "" : "the model fast or "}panels with fewer pixels (the panels still follow the eyes)` : health(status));
  tellLoading(status);
  if (status.state === undefined) return; // no refresh yet
  document.querySelector('[data-command="pause"]').setAttribute("aria-pressed", String(status.paused));
  document.querySelector('[data-command="flat"]').setAttribute("aria-pressed", String(status.flat_asked));
  for (const [id, value] of [["scene", status.scene], ["model", status.model_asked]]) {
    if (document.activeElement !== $(id) && !$(id).dataset.touched) CHOICES[id].value = value;
  }
  $("content-problem").hidden = !status.content_problem;
  setText($("content-problem"), status.content_problem ?? "");
  playlist(status.playlist);
  placing(status.placing);
  plot(status);
  drawEyes(status);
  figures(status);
  leftOut(status);
}

async function every(ms, work) {
  for (;;) {
    let pause = document.hidden ? 4 * ms : ms;
    try {
      if ((await work()) === false) pause = RETRY_MS / 4; // the daemon's state is not known yet
    } catch {
      gone("This page's server does not answer; it has stopped or the network is down", null);
      pause = RETRY_MS;
    }
    await new Promise((done) => setTimeout(done, pause));
  }
}

every(STATUS_MS, async () => {
  const status = await lookUp("status");
  if (status.ok) show(status);
  else gone(status.error, status.hangs);
});
every(PICTURES_MS, async () => {
  pictureTime();
  if (running && !document.hidden) await lookAtPictures();
});
every(LOG_MS, async () => {
  if (!running) return false;
  const answer = await lookUp("log");
  if (!answer.ok) return;
  entries($("log"), answer.lines, (line) => [line.text, { level: line.level }]);
  const [faults, states] = [answer.faults ?? [], answer.states.filter((s) => !s.state.startsWith("degraded"))];
  entries($("states"), states, (s) => [`${s.state}: ${s.reason}`, { state: s.state }]);
  entries($("faulty"), faults, (s) => [s.reason + (s.file ? `; black box: ${s.file}` : ""), { state: "degraded" }]);
  if (answer.states.at(-1)?.state.startsWith("degraded")) faultSince_s = answer.states.at(-1).time_s;
});
every(ABOUT_MS, async () => {
  if (!running) return false;
  const answer = await lookUp("about");
  if (!answer.ok) return;
  about = answer;
  CHOICES.scene.offer(scenesOf(answer));
  CHOICES.model.offer(modelsOf(answer));
  setText(document.querySelector(".presets"), answer.presets.join(", "));
});

// Commands.

async function tell(button, command, value = null, where = $("told")) {
  if (button) button.disabled = true;
  if (["scene", "model", "reload"].includes(command)) pending = where;
  where.dataset.kind = "";
  setText(where, `${command}: sent`);
  let done = false;
  try {
    const answer = await ask("/do", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ command, value }),
    });
    const said = await answer.json();
    done = said.ok === true;
    if (done) clearErrors();
    where.dataset.kind = said.ok ? "" : "bad";
    setText(where, said.ok ? `${command}: done${said.file ? `: ${said.file}` : said.note ? `: ${said.note}` : ""}` : `${command}: ${said.error}`);
  } catch {
    where.dataset.kind = "bad";
    setText(where, `${command}: this page's server does not answer`);
  } finally {
    if (pending === where) pending = null;
    if (button) {
      button.disabled = !running;
      if (document.activeElement === document.body) button.focus();
    }
  }
  return done;
}

for (const button of document.querySelectorAll("[data-command]")) {
  button.addEventListener("click", () => tell(button, button.dataset.command, null, $(button.dataset.command === "next" ? "scene-told" : "told")));
}
for (const [id, choice] of Object.entries(CHOICES)) {
  for (const field of [choice.select, choice.other]) field.addEventListener("input", () => ($(id).dataset.touched = "yes"));
  $(`${id}-form`).addEventListener("submit", async (event) => {
    event.preventDefault();
    const done = await tell(event.submitter ?? event.target.querySelector("button"), id, choice.value, $(`${id}-told`));
    if (done) delete $(id).dataset.touched;
  });
}
