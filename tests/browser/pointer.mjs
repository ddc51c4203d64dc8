// node pointer.mjs URL MOVES SECONDS: how soon the page of `phasestack try` shows a picture that was drawn for the pointer's new
// place, after it went there in FLICK_MS, and how many of them a second while it keeps moving (tests/browser/pointer.py).
import { opened, say } from "./chromium.mjs";

const [, , url, moves, seconds] = process.argv;
const THERE_M = 0.003, PLACE_M = 0.6, IPD_M = 0.063, REACH_M = [0.5, 0.3]; // of the head, across the picture; of 5 to 20 cm each
const FLICK_MS = 200;
const { origin } = new URL(url);
const status = () => page.evaluate(() => window.phasestack.status());
const { browser, page: newPage } = await opened({ origin, width: 1280, height: 800 });
const page = await newPage();
// A solution counts from the frame after the one that drew it: by then its panels and both eyes' pictures are on the way to the screen.
await page.addInitScript(() => {
  const seen = (window.seen = { pointed_ms: 0, shown: [], frames: 0 });
  const next = () => new Promise((done) => requestAnimationFrame(done)), { send } = WebSocket.prototype, sockets = new WeakSet();
  let asked = null;
  addEventListener("pointermove", (event) => (seen.pointed_ms = event.timeStamp), true);
  WebSocket.prototype.send = function (data) {
    if (!sockets.has(this)) {
      sockets.add(this);
      this.addEventListener("message", ({ data: text }) => { if (typeof text === "string" && text.includes('"layers"')) asked = JSON.parse(text); });
    }
    send.call(this, data);
    if (data === '{"drawn":true}' && asked?.layers === "solved") {
      const [{ eyes_m: eyes } = {}] = asked.solved_for;
      next().then(next).then((ms) => eyes && seen.shown.push({ eyes, ms }));
    }
  };
  const count = () => requestAnimationFrame(() => { seen.frames += 1; count(); });
  count();
});
await page.goto(url);
await page.evaluate(() => window.phasestack.ready);
await page.click("[data-mode=parallel]");
const box = await page.locator("canvas").boundingBox();
const to = (y_m, z_m) => page.mouse.move(box.x + box.width * (0.5 + y_m / REACH_M[0]), box.y + box.height * (0.5 - z_m / REACH_M[1]));
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
let state = 7;
const random = () => (state = (state * 48271) % 2147483647) / 2147483647; // the same places every time

await to(0, 0);
await pause(5000);
const latencies = [], lost = [];
let place = [0, 0];
for (let k = 0; k < Number(moves); k += 1) {
  let there = place;
  while (Math.hypot(there[0] - place[0], there[1] - place[1]) < 0.05) there = [0.24 * (random() - 0.5), 0.14 * (random() - 0.5)];
  await page.evaluate(() => (window.seen.shown.length = 0));
  const begin = performance.now(), from = place;
  place = there;
  for (let share = 0; share < 1; ) {
    share = Math.min(1, (performance.now() - begin) / FLICK_MS);
    const smooth = share * share * (3 - 2 * share);
    await to(...from.map((v, n) => v + (place[n] - v) * smooth));
  }
  const norm = Math.hypot(PLACE_M, place[0]), right = [-place[0] / norm, PLACE_M / norm, 0];
  const eyes = [-IPD_M / 2, IPD_M / 2].map((v) => [PLACE_M, ...place].map((at, n) => at + v * right[n]));
  const ms = await page.evaluate(([limit, wanted]) => new Promise((done) => {
    const begin = performance.now(), far = (a, b) => Math.hypot(...a.map((v, n) => v - b[n]));
    const look = () => {
      const first = window.seen.shown.find(({ eyes, ms }) =>
        ms > window.seen.pointed_ms && Math.max(far(eyes[0], wanted[0]), far(eyes[1], wanted[1])) < limit);
      if (first) done(first.ms - window.seen.pointed_ms);
      else if (performance.now() - begin > 20000) done(null);
      else setTimeout(look, 5);
    };
    look();
  }), [THERE_M, eyes]);
  (ms === null ? lost : latencies).push(ms);
  await pause(200 + 600 * random());
}
say("latencies_ms", latencies);
say("never_shown", lost.length);

// A head that leans: 10 cm to either side, once in three seconds.
const efforts = {}, away_mm = [];
await page.evaluate(() => (window.seen.shown.length = window.seen.frames = 0));
const begin = performance.now();
let asked = begin, first = null, last = null;
while (performance.now() - begin < 1000 * Number(seconds)) {
  const phase = ((performance.now() - begin) / 3000) * 2 * Math.PI;
  await to(0.1 * Math.sin(phase), 0.02 * Math.sin(2 * phase));
  if (performance.now() > asked) {
    asked = performance.now() + 500;
    const now = await status();
    [first, last] = [first ?? now.solution, now.solution];
    efforts[now.effort ?? "full"] = (efforts[now.effort ?? "full"] ?? 0) + 1;
    if (typeof now.view_error_estimated_now_mm === "number") away_mm.push(now.view_error_estimated_now_mm);
  }
  await pause(8);
}
const [shown, frames] = await page.evaluate(() => [window.seen.shown.length, window.seen.frames]), took_s = (performance.now() - begin) / 1000;
say("solved_per_s", (last - first) / took_s);
say("shown_per_s", shown / took_s);
say("frames_per_s", frames / took_s);
say("efforts", efforts);
say("view_error_mm", away_mm);
await browser.close();
