// Script for the live display, which shows the panels. The pointer acts as a head seen by the daemon's sensor.
import { Look } from "/look.js";
import { Choice, MORE, effortInWords, modelsOf, scenesOf } from "/choice.js";
import { ask, token } from "/session.js";

// AGAIN_MS: how often a resting head's position is sent again.
// KEPT: number of latencies used for statistics.
// ENDED_MS: for how long the server must be unreachable until the page reports that it has ended.
// MOVED_M: how far the eyes may be from those that a figure was measured for, the same as in runtime.frame.sampling.
const AGAIN_MS = 500, STATUS_MS = 500, RETRY_MS = 1000, ENDED_MS = 5000, MOVED_M = 0.002, KEPT = 600;
const NO_ANSWER = "No answer from phasestack try. Trying again …";
// PLACES_M: where each head starts.
const PLACES_M = [[0.6, 0, 0], [0.6, 0.28, 0]];
// A quick head's peak acceleration, the duration of its shortest movement, and the time between samples.
const PEAK_M_S2 = 12, LEAST_S = 0.1, STEP_MS = 12;
const FIRST = `
<p class="who" role="status"></p>
<form><label hidden>Seen by <select name="seen_by"></select></label>
<label>Scene <select name="scene"></select></label>
<label>File or folder <input type="text" name="scene_file" autocomplete="off" placeholder="/home/me/model.glb"></label>
<label>Model <select name="model"></select></label>
<label>ONNX file <input type="text" name="model_file" autocomplete="off" placeholder="/home/me/model.onnx"></label>
<label>Gap between panels, 1 to 500 mm <input type="number" name="gap_mm" min="1" max="500" step="any" required></label></form>
<p class="told" role="status"></p>${MORE}`;
const CONTROLS = `
<dl class="figures"></dl>
<form><label>Sensor noise, mm <input type="number" name="noise_mm" min="0" max="50" step="0.1"></label>
<label>Sensor latency, ms <input type="number" name="latency_ms" min="0" max="1000" step="5"></label>
<label>Distance between eyes, mm <input type="number" name="ipd_mm" min="45" max="80" step="1"></label>
<label>Turntable, turns per minute <input type="number" name="turntable" min="-60" max="60" step="1" value="0"></label>
<label class="tick"><input type="checkbox" name="camera"> track the head with this browser's camera</label>
<label hidden>Camera's horizontal field of view, degrees <input type="number" name="camera_fov_deg" min="20" max="150" step="1" value="65"></label>
<figure class="found" hidden><svg role="img" aria-label="Camera picture with the detected pupils"></svg><figcaption></figcaption></figure>
<label class="tick"><input type="checkbox" name="held"> pause the solver, so that only the alignment follows the head</label>
<label class="tick"><input type="checkbox" name="lost"> hide the viewer's eyes, as if the viewer had left</label></form>
<p><a href="/operator">Open the operator's page</a></p>`;

let look = null, socket = null, mode = {}, lastSent = 0, ipd_m = 0.063, newest = null, pending = null;
// me: number of the head that this page moves, or null. people: those served, with their eyes. solved: people that the
// loaded layers were solved for. seenBy: whose picture is shown (`idOf`); null: this page's own. heads: of people, by number.
let me = null, people = [], solved = [], seenBy = null, heads = {};
let checks = false, camera = null, lookedAt = null;
// wishes: number of commands in progress. answered_ms: when the last command ended.
// measured: number of the measured refresh whose target pictures are loaded.
// used: numbers in use, by field name. changing: the change whose first picture has not been drawn, or null. loaded: the
// state that the drawn layers were solved in. trouble: why there is no connection. unreachable_ms: since when.
let choices = {}, used = {}, changing = null, loaded = null, trouble = "", unreachable_ms = null;
let layersSeen = { solved: false, flat: false }, first = null, wishes = 0, answered_ms = 0, measured = null;
const latencies = [], drawn = [];
const main = document.querySelector("main");

// Positions of both eyes of a head that faces the display's centre.
function eyesOf(head) {
  const at = PLACES_M[me ?? 0].map((v, k) => v + head[k]), norm = Math.hypot(at[0], at[1]);
  const right = [-at[1] / norm, at[0] / norm, 0];
  return [-0.5, 0.5].map((side) => at.map((v, k) => v + side * ipd_m * right[k]));
}

// A person's head, which stays the same if the person is lost and comes back with another number.
const idOf = ({ number }) => (mode.is_sensor ? heads[number] ?? -1 : number - 1);
const own = () => (me === null ? people[0] : people.find((person) => idOf(person) === me));
const seen = () => people.find((person) => idOf(person) === seenBy) ?? own();
const seenAmong = (others) => others.findIndex((one) => seen() && idOf(one) === idOf(seen()));

// The true eyes if this page's pointer moves them. If not, the eyes last measured by the daemon for another page or a
// camera.
const eyesNow = (head) => (me === null || seen() !== own() ? seen()?.eyes_m ?? eyesOf([0, 0, 0]) : eyesOf(head));
const say = (message) => { if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message)); };

// The head follows the pointer along a minimum-jerk path, which is replanned whenever the pointer moves. Otherwise, if
// the pointer jumped, the tracker would think that it saw another person.
let way = { begin_ms: 0, seconds: 0, curves: [0, 1, 2].map(() => [0, 0, 0, 0, 0, 0]) }, step = null;

// The head's position, velocity and acceleration along each axis.
function motion(ms) {
  const t = Math.min((ms - way.begin_ms) / 1000, way.seconds);
  return way.curves.map(([a, b, c, d, e, f]) => [a + t * (b + t * (c + t * (d + t * (e + t * f)))),
    b + t * (2 * c + t * (3 * d + t * (4 * e + t * 5 * f))), 2 * c + t * (6 * d + t * (12 * e + t * 20 * f))]);
}
const head = () => motion(performance.now()).map(([place]) => place);

function follow() {
  const now = performance.now(), moving = motion(now), away = Math.hypot(...moving.map(([place], k) => look.head[k] - place));
  // A minimum-jerk movement has a peak acceleration of 5.77 times away / T².
  const T = Math.max(LEAST_S, Math.sqrt((5.77 * away) / PEAK_M_S2));
  way = { begin_ms: now, seconds: T, curves: moving.map(([p, v, a], k) => {
    const rest = look.head[k] - p - v * T - (a * T * T) / 2, speed = -v - a * T;
    return [p, v, a / 2, (10 * rest) / T ** 3 - (4 * speed) / T ** 2 - a / (2 * T), (-15 * rest) / T ** 4 + (7 * speed) / T ** 3 + a / T ** 2,
      (6 * rest) / T ** 5 - (3 * speed) / T ** 4 - a / (2 * T ** 3)];
  }) };
  step ??= setTimeout(go, STEP_MS);
}

function go() {
  step = performance.now() < way.begin_ms + 1000 * way.seconds ? setTimeout(go, STEP_MS) : null;
  see();
  look.draw();
}

function see() {
  if (!look || me === null) return;
  lastSent = performance.now();
  const gone = document.hidden || form("lost").checked, moving = motion(lastSent), velocity_m_s = moving.map(([, v]) => v);
  say({ eyes: gone ? null : eyesOf(moving.map(([place]) => place)), velocity_m_s: step === null ? null : velocity_m_s, page_ms: lastSent });
}

const form = (name) => main.querySelector(`[name=${name}]`);
const told = (text) => (main.querySelector(".told").textContent = text);

// Use a number if it is within the field's range. If not, report the range and show the number in use.
function set(field) {
  const { name, min, max, parentElement: { textContent: label } } = field, value = Number(field.value);
  if (!field.value || !field.checkValidity()) {
    told(`${label.split(",")[0].trim()}: must be a number from ${min} to ${max}`);
    return void (field.value = used[name]);
  }
  if (name === "gap_mm" && value !== used.gap_mm) changes({ text: `Restarting with a gap of ${value} mm …`, restarts: true });
  used[name] = value;
  told("");
  if (name === "turntable") wish("place", { turntable_per_min: value });
  else if (name !== "ipd_mm") say({ [name]: value });
  else {
    ipd_m = value / 1000;
    look.moveTo(look.head);
  }
}

// The panels show the last picture until the change has been made, and then until its first picture has been solved.
function changes(change) {
  changing = change && { ...change, from: loaded };
  refreshed();
}

// Send a command to the daemon. change: its effect on the picture (`changes`), or undefined.
async function wish(command, value = null, change = undefined) {
  told(`${command} …`);
  wishes += 1;
  try {
    const answer = await (await reach("/do", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ command, value }) })).json();
    told(answer.ok ? "" : answer.error);
    if (!answer.ok && change === changing) changes(null);
  } catch {
    told(`No answer to: ${command}. Try again.`);
    if (change === changing) changes(null);
  }
  wishes -= 1;
  answered_ms = performance.now();
}

// Like `ask`, and keep since when the server has been unreachable.
async function reach(...request) {
  try {
    const answer = await ask(...request);
    unreachable_ms = null;
    trouble = answer.status === 401 ? "The token in this page's address is missing or wrong. Open the address that phasestack try printed." :
      trouble && !socket.isHeard ? NO_ANSWER : "";
    return answer;
  } catch (error) {
    unreachable_ms ??= performance.now();
    if (trouble && performance.now() - unreachable_ms > ENDED_MS) trouble = "phasestack try has ended. Start it again and open the address it prints.";
    throw error;
  } finally {
    refreshed();
  }
}

// Show why the picture is missing or does not match the choice.
function refreshed() {
  const starting = main.querySelector(".starting"), nobody = newest?.state && !newest.people.length;
  if (starting && trouble) starting.textContent = trouble;
  look?.notice(trouble || changing?.text.concat(changing.reason ?? "") || (!layersSeen.solved && !nobody ? "Solving the first picture …" : !checks ? "" :
    measured === null ? "Measuring the current picture …" : newest && newest.measured_frame !== measured ? "This was measured before the last change. Measuring again …" : ""));
  light();
}

function build({ stack, fov_deg }) {
  main.replaceChildren();
  const title = stack.x_m.length > 2 ? `${stack.x_m.length} panels, live` : "two panels, live";
  const picture = { width: stack.width_px, height: stack.height_px };
  look = new Look(main, { stack, fov_deg, picture, eyes_m: null }, { title, eyesAt: eyesNow, onTheWay: head });
  look.live = true;
  look.onhead = follow;
  look.onmode = check;
  look.onchange = light;
  main.querySelector(".first").innerHTML = FIRST;
  main.querySelector(".more").innerHTML = CONTROLS;
  choices = {
    scene: new Choice(form("scene"), form("scene_file"), { text: "another file or folder …" }),
    model: new Choice(form("model"), form("model_file"), { text: "an ONNX file …" }),
  };
  for (const [name, value] of [["noise_mm", 0.2], ["latency_ms", 0], ["ipd_mm", ipd_m * 1000]]) form(name).value = used[name] = value;
  Object.assign(used, { camera_fov_deg: 65, turntable: 0 });
  for (const name of ["noise_mm", "latency_ms", "ipd_mm", "gap_mm", "turntable", "camera_fov_deg"]) form(name).addEventListener("change", (event) => set(event.target));
  for (const [name, choice] of Object.entries(choices))
    for (const field of [choice.select, choice.other]) field.addEventListener("change", () => {
      if (!choice.value) return;
      changes({ text: `Loading the ${name} ${choice.value} …` });
      wish(name, choice.value, changing);
    });
  form("held").addEventListener("change", (event) => wish(event.target.checked ? "pause" : "resume"));
  form("lost").addEventListener("change", see);
  form("seen_by").addEventListener("change", (event) => {
    seenBy = Number(event.target.value);
    settle();
    if (checks) say({ checks }); // the target pictures are sent again
    look.draw();
  });
  form("camera").addEventListener("change", (event) => film(event.target.checked));
  for (const each of main.querySelectorAll("form")) each.addEventListener("submit", (event) => event.preventDefault());
  look.onframe = painted;
  follow();
  about();
}

// Target pictures exist only for measured refreshes. A mode that needs them shows the latest measured refresh instead
// of the live picture.
function check(on) {
  if (on === checks) return;
  checks = on;
  measured = null;
  for (const side of [0, 1]) look.display.target(side, null);
  refreshed();
  say({ checks });
}

// Send pictures from this browser's camera if the user allows it. Each picture is sent once the daemon has answered the
// previous one, or after 250 ms.
async function film(on) {
  camera?.getTracks().forEach((track) => track.stop());
  camera = null;
  if (!on) return say({ camera: 0 });
  try {
    camera = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 640 }, frameRate: { ideal: 30 } } });
  } catch (error) {
    form("camera").checked = false;
    return told(`The camera cannot be used: ${error.message}`);
  }
  const mine = camera, video = Object.assign(document.createElement("video"), { srcObject: mine, muted: true, playsInline: true });
  await video.play();
  say({ camera: 1 });
  const scale = Math.min(1, 640 / video.videoWidth), canvas = new OffscreenCanvas(video.videoWidth * scale, video.videoHeight * scale);
  const plain = canvas.getContext("2d", { willReadFrequently: true });
  while (camera === mine) {
    const taken_ms = performance.now();
    plain.drawImage(video, 0, 0, canvas.width, canvas.height);
    const coded = await [0.85, 0.6, 0.3].reduce(async (before, quality) => { // use the best quality that fits a message
      const blob = await before;
      return blob?.size < 60000 ? blob : canvas.convertToBlob({ type: "image/jpeg", quality });
    }, null);
    if (camera !== mine) return;
    const answered = new Promise((done) => { lookedAt = done; setTimeout(done, 250); });
    say({ picture_ms: taken_ms });
    if (socket?.readyState === WebSocket.OPEN) socket.send(coded);
    await answered;
  }
}

function found({ url, size: [width, height], pupils_px, reason }) {
  lookedAt?.();
  const box = main.querySelector(".found");
  box.hidden = false;
  const svg = box.querySelector("svg"), made = (name, attributes) => {
    const shape = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) shape.setAttribute(key, value);
    return shape;
  };
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const rings = (pupils_px ?? []).map(([cx, cy], side) => made("circle", { cx, cy, r: 6, class: `pupil ${side ? "right" : "left"}` }));
  svg.replaceChildren(made("image", { href: url, width, height }), ...rings);
  box.querySelector("figcaption").textContent = pupils_px ? "camera picture with the detected pupils" : `no viewer: ${reason}`;
}

function painted() {
  drawn.push(performance.now());
  while (drawn[0] < drawn.at(-1) - 1000) drawn.shift();
  if (newest?.page_ms && newest.page_ms !== painted.counted && newest.eyes_label !== "rested") {
    painted.counted = newest.page_ms;
    latencies.push(performance.now() - newest.page_ms);
    if (latencies.length > KEPT) latencies.shift();
  }
}

// Relate the loaded layers to the people who are served now. Twin of matched in runtime/frame/served.py.
function settle() {
  const now = seen(), both = solved.flatMap((then) => people.filter(({ number }) => number === then.number).map((one) => [then, one]));
  if (!both.length && solved.length && people.length) both.push([solved[0], people[0]]);
  look.between = both.length ? [0, 1].map((k) => both.flatMap((pair) => pair[k].eyes_m)) : null;
  look.scene.eyes_m = (solved[seenAmong(solved)] ?? solved[0])?.eyes_m ?? look.scene.eyes_m;
  look.others = people.filter((one) => one !== now).flatMap((one) => one.eyes_m);
}

// Report which person this page is, and offer the pictures of all.
function introduce() {
  const { stack: { x_m }, is_sensor } = mode, list = form("seen_by");
  const panels = `${x_m.length} panels serve one person`, more = x_m.length < 4 ? "With four panels or tracker.viewers = 2" : "With tracker.viewers = 2";
  const text = !is_sensor ? "" : me === null ? (mode.heads > 1 ? "This page only watches, because two other pages are the two people." : `This page only watches, because ${panels}. ${more}, a second page is a second person.`) :
    mode.heads < 2 ? "" : !own() ? "You are not served yet." : `You are person ${me + 1}.${me === 0 && people.length < 2 ? " Open this page in a second window as well, and it is a second person." : ""}`;
  const who = main.querySelector(".who");
  if (who.textContent !== text) who.textContent = text;
  look.$(".how").hidden = me === null;
  list.parentElement.hidden = people.length < 2;
  const names = people.map((one) => [idOf(one), me !== null && one === own() ? "me" : `person ${idOf(one) + 1}`]).sort();
  if (list.dataset.key !== (list.dataset.key = JSON.stringify(names))) list.replaceChildren(...names.map(([value, name]) => new Option(name, value)));
  list.value = seen() ? idOf(seen()) : "";
}

function take({ refresh, head, page_ms }) {
  const before = newest, moved = me !== head;
  [newest, me] = [{ ...refresh, page_ms, measured_ms: performance.now() - 1000 * refresh.light_age_s }, head];
  if (!look || !refresh.state) return;
  if (refresh.people.length) people = refresh.people;
  for (const one of people) if (one.head !== null) heads[one.number] = one.head;
  settle();
  introduce();
  if (moved) see();
  look.sigma_m = (refresh.eye_sigma_mm ?? 0) / 1000;
  const flatness = checks ? 0 : layersSeen.solved ? (layersSeen.flat ? refresh.flatness : 0) : 1;
  const same = before && look.flatness === flatness && JSON.stringify(before.people) === JSON.stringify(refresh.people);
  look.flatness = flatness;
  const state = refresh.state === "tracking" ? (checks ? age(refresh) : "") : explained(refresh), told = state === look.state;
  look.state = state;
  const { state_version, is_current } = refresh, since_s = (performance.now() - answered_ms) / 1000;
  const made = refresh.people.length ? is_current && state_version === loaded : since_s > 2;
  if (changing && !changing.restarts && !wishes && made && (loaded !== changing.from || since_s > 2)) changing = null;
  refreshed();
  if (!same || !told) look.draw();
  if (layersSeen.solved && flatness < 1) first?.();
}

// Show the light that the daemon has measured, if it belongs to the picture drawn now: to its content, model and eyes.
function light() {
  if (!look) return;
  const { state, light_db, measured_ms, measured_frame, state_version } = newest ?? {}, eyes_m = seen()?.eyes_m, s = (performance.now() - measured_ms) / 1000;
  const tracked = state === "tracking" && layersSeen.solved && !changing && !trouble;
  const here = checks ? measured_frame === measured : state_version === loaded && eyes_m?.flat().every((v, k) => Math.abs(v - look.eyes.flat()[k]) <= MOVED_M);
  if (tracked && here && typeof light_db === "number") look.tell(light_db, s >= 2 ? `, measured ${s.toFixed(0)} s ago` : "");
  else look.tell(null, tracked ? "Light at both eyes: not measured yet for this picture." : "");
}

// Refresh that the target pictures belong to. Older ones stay until the current refresh has been measured.
function age({ measured_frame }) {
  if (measured === null) return "";
  return measured_frame === measured ? "Measured for this position of the head." : "Measured before the head, the scene or the model changed.";
}

// A message that explains why the picture differs from the two eyes' targets.
function explained({ state, reason }) {
  const late = /solutions take (\d+) ms|has not answered for (\d+) ms/.exec(reason);
  if (!late) return `${state.split(":")[0]}: ${reason}`;
  const seconds = ((late[1] ?? late[2]) / 1000).toFixed(1);
  return `A solution takes ${late[1] ? "" : "more than "}${seconds} s on this machine. Until the next solution, the panels are aligned to your head. ` +
    "To speed this up, choose the model fast, close other programs or configure smaller panels with --config.";
}

function load(bytes) {
  const { layers: kind, solved_for, state_version, target, relief, frame, size: [w, h] } = pending, size = 4 * w * h * look.stack.x_m.length;
  if (kind === "solved") solved = solved_for, settle();
  look.display.load(kind, new Uint8Array(bytes, 0, size), [w, h]);
  if (kind === "solved") look.display.unfold(relief ? new Uint16Array(bytes, size, relief[0] * relief[1]) : null, relief);
  if (target) {
    const [width, height] = target, length = 4 * width * height, person = seenAmong(solved);
    look.scene.picture = { width, height };
    for (const side of [0, 1])
      look.display.target(side, person < 0 ? null : new ImageData(new Uint8ClampedArray(bytes, size + (2 * person + side) * length, length), width, height));
    measured = person < 0 ? null : frame;
  }
  layersSeen[kind] = true;
  if (kind === "solved") [loaded, changing] = [state_version, changing?.begun ? null : changing];
  refreshed();
  look.draw();
  say({ drawn: true });
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/live`, ["phasestack", token() || "none"]); // an empty one would be an error
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") return load(data);
    const message = JSON.parse(data);
    [socket.isHeard, trouble] = [true, ""];
    if (message.layers) pending = message;
    else if (message.stack) {
      layersSeen = { solved: false, flat: false };
      if (changing?.restarts) changing.begun = true;
      [measured, newest, loaded] = [null, null, null];
      [mode, people, solved, seenBy, heads] = [message, [], [], null, {}];
      const same = look && ["width_px", "height_px"].every((k) => look.stack[k] === message.stack[k]) && look.stack.x_m.length === message.stack.x_m.length;
      if (same) look.turnTo(message.stack);
      else build(message);
      refreshed();
      form("camera").checked = message.is_camera;
      form("camera_fov_deg").parentElement.hidden = mode.is_sensor;
      if (mode.is_sensor) main.querySelector(".found").hidden = true;
      form("gap_mm").value = used.gap_mm = Math.round(1e5 * (message.stack.x_m[1] - message.stack.x_m[0])) / 100;
      if (checks) say({ checks });
    } else if (message.found) found(message.found);
    else if (message.refresh) {
      say({ heard: true });
      take(message);
    }
  };
  socket.onclose = () => {
    [newest, drawn.length, latencies.length] = [null, 0, 0];
    for (const kind of [".figures", ".head"]) main.querySelector(kind)?.replaceChildren();
    socket.isHeard = false;
    trouble ||= NO_ANSWER;
    refreshed();
    setTimeout(connect, RETRY_MS);
  };
}

const status = async () => (await reach("/now/status")).json();
const number = (value, digits = 1) => (value ?? 0).toFixed(digits);

async function about() {
  try {
    const answer = await (await reach("/now/about")).json();
    if (!answer.ok) throw new Error(answer.error);
    choices.scene.offer(scenesOf(answer));
    choices.model.offer(modelsOf(answer));
    main.querySelector(".presets").textContent = answer.presets.join(", ");
  } catch {
    setTimeout(about, RETRY_MS);
  }
}

// Show the figures in a status. asked_ms: when the status was requested. The controls are updated only if this was
// after the last command had ended.
function figures(now, asked_ms) {
  const at = (share) => [...latencies].sort((a, b) => a - b)[Math.floor(share * (latencies.length - 1))];
  const rests = now.eyes_label === "rested", solves = now.solutions_per_s_now > 0;
  const { view_error_estimated_mm: error_mm } = now.people.find(({ number }) => number === seen()?.number) ?? {};
  const rows = { // any row without a value is omitted
    "page": drawn.length > 1 && `${drawn.length} pictures per second`,
    "panels": now.fps_now > 0 && `${number(now.fps_now)} refreshes per second`,
    "solver": solves ? `${number(now.solutions_per_s_now)} solutions per second (${now.model})` : now.paused ? "paused" : rests && "idle while the head rests",
    "effort": solves && now.effort && effortInWords(now.effort),
    "estimated view error": solves && typeof error_mm === "number" && `${number(error_mm)} mm`,
    "solution age": solves && `${number(now.solution_age_now_ms, 0)} ms`,
    "uncertainty of the eyes": typeof now.eye_sigma_now_mm === "number" && `${number(now.eye_sigma_now_mm, 2)} mm (${now.eyes_label})`,
    "delay between pointer and picture": latencies.length > 20 && `${number(at(0.5), 0)} ms median, 99% within ${number(at(0.99), 0)} ms`,
    ...(now.program ? { "drawing program": now.missing?.content ?? (now.program.frame_ms > 0 && `${number(now.program.frame_ms, 0)} ms per frame`), "program's address": now.program.address } : {}),
  };
  main.querySelector(".figures")?.replaceChildren(...Object.entries(rows).filter(([, text]) => text).flatMap(([name, text]) =>
    [["dt", name], ["dd", text]].map(([kind, textContent]) => Object.assign(document.createElement(kind), { textContent }))));
  if (wishes || asked_ms < answered_ms) return;
  if (changing) changing.reason = now.paused ? " (the solver is paused)" : "";
  for (const [name, value] of [["scene", now.scene], ["model", now.model_asked]]) {
    const { select, other, isOther } = choices[name];
    if (![select, other].includes(document.activeElement) && !(isOther && !other.value)) choices[name].value = value;
  }
  if (form("held")) form("held").checked = Boolean(now.paused);
}

async function report() {
  try {
    const asked_ms = performance.now(), now = await status();
    const starting = main.querySelector(".starting");
    if (starting && now.reason && !trouble) starting.textContent = `Starting: ${now.reason}. The first start on a machine takes about ten seconds longer.`;
    if (look && now.ok && now.scene !== undefined) figures(now, asked_ms); // before the first refresh, keep the old figures
    else if (changing?.restarts && now.reason) changing.reason = ` (${now.reason})`;
  } catch {
    // The failure is reported by the handler for closed connections.
  }
  setTimeout(report, document.hidden ? 4 * STATUS_MS : STATUS_MS);
}

window.phasestack = {
  ready: new Promise((done) => (first = done)).then(() => Object.assign(window.phasestack, look.doors)),
  status,
  eyes: () => look.eyes,
  latencies: () => [...latencies],
};
setInterval(() => {
  if (performance.now() - lastSent >= AGAIN_MS) see();
  light(); // its age
}, AGAIN_MS);
document.addEventListener("visibilitychange", see);
connect();
report();
