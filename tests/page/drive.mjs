// Drives the page in Debian's Chromium: NODE_PATH=... node drive.mjs ORIGIN TOKEN FOLDER PLAYLIST, with playwright-core and
// axe-core under NODE_PATH. Prints a line of JSON for each thing tried; on the line "kill" or "start" its parent ends
// or starts the daemon and answers with a line on stdin.
import { createRequire } from "node:module";
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";

const find = createRequire(process.env.NODE_PATH + "/x");
const { chromium } = find("playwright-core");
const axe = readFileSync(find.resolve("axe-core/axe.min.js"), "utf8");
const [, , origin, token, folder, playlist] = process.argv;
const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();
const say = (what, value) => console.log(JSON.stringify({ what, value }));
const parent = async (wish) => { say(wish, null); await lines.next(); };

const browser = await chromium.launch({
  executablePath: "/usr/bin/chromium",
  args: ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync"],
});
const context = await browser.newContext({ viewport: { width: 1280, height: 900 } });
const page = await context.newPage();
const elsewhere = [], violations = [];
page.on("request", (request) => { if (!/^(data:|blob:)/.test(request.url()) && !request.url().startsWith(origin)) elsewhere.push(request.url()); });
page.on("console", (message) => { if (/Content Security Policy/.test(message.text())) violations.push(message.text()); });
page.on("pageerror", (error) => violations.push(error.message));

const now = () => page.evaluate(async () => (await fetch("/now/status", { headers: { Authorization: `Bearer ${localStorage.getItem("token")}` } })).json());
const until = async (holds, within_ms = 60000) => {
  const end = Date.now() + within_ms;
  while (Date.now() < end) {
    if (await holds()) return true;
    await page.waitForTimeout(200);
  }
  return false;
};
const statusIs = (holds) => until(async () => { const s = await now(); return s.ok && holds(s); });
const told = (text) => until(async () => (await page.textContent("main")).includes(text));
const shows = (selector, text) => until(async () => (await page.textContent(selector)).includes(text));
const findings = async (target) => {
  await target.evaluate(axe);
  const found = await target.evaluate(() => window.axe.run(document));
  return found.violations.filter((v) => ["serious", "critical"].includes(v.impact)).map((v) => `${v.id}: ${v.nodes[0].html}`);
};

// A wrong token.
await page.goto(origin);
say("login is accessible", await findings(await evaluated(page)));
await page.fill("#token", "wrong");
await page.keyboard.press("Enter");
await page.waitForSelector("#refused:not([hidden])");
say("a wrong token gets nothing", await page.evaluate(async () => {
  const codes = [];
  for (const path of ["/now/about", "/now/status", "/now/pictures", "/now/log", "/now/other"]) codes.push((await fetch(path)).status);
  return codes;
}));

// In, by the keyboard alone.
await page.fill("#token", token);
await page.keyboard.press("Enter");
await page.waitForSelector("#login", { state: "hidden" });
say("state is shown", await until(async () => ["tracking", "holding", "flat", "degraded"].some((s) => s === null) ||
  /tracking|holding|flat|degraded/.test(await page.textContent("#state"))));
say("health is told", await shows("#reason", "All is well"));
say("pictures are shown", await until(() => page.evaluate(() =>
  [...document.querySelectorAll("#pictures img[src]")].filter((i) => i.naturalWidth > 100).length >= 3)));

const choose = async (id, value) => {
  const listed = await page.$$eval(`#${id} option`, (options, value) => options.some((o) => o.value === value), value);
  await page.selectOption(`#${id}`, listed ? value : "\u2026");
  if (!listed) await page.fill(`#${id}-file`, value);
  await page.click(`#${id}-form button`);
};
await page.waitForSelector("#scene option[value=grey]", { state: "attached" });
say("every scene in the list works", await page.$$eval("#scene option", (options) => options.map((o) => o.value)));
say("and those that need data are named", (await page.textContent(".presets")).includes("lego_bulldozer"));
say("models to choose from", await page.$$eval("#model option", (options) => options.map((o) => o.value)));

// Live figures change.
const seen = new Set(), frames = new Set(), curves = new Set(), eyes = new Set();
for (let k = 0; k < 40; k += 1) {
  seen.add(await page.textContent("#numbers dd:nth-of-type(5)"));
  frames.add(await page.getAttribute("#pictures", "data-frame"));
  curves.add(await page.getAttribute("#plots path", "d"));
  eyes.add(await page.innerHTML("#above"));
  await page.waitForTimeout(250);
}
say("figures changed", [seen.size, frames.size, curves.size, eyes.size]);

// Every control.
await page.click("[data-command=pause]");
say("a pause is told", (await shows("#reason", "Paused by you")) && (await page.getAttribute("#state", "data-state")) === "paused");
say("pause", (await told("pause: done")) && (await statusIs((s) => s.paused)) &&
  (await until(async () => (await page.getAttribute("[data-command=pause]", "aria-pressed")) === "true")));
await page.click("[data-command=resume]");
say("resume", (await told("resume: done")) && (await statusIs((s) => !s.paused)));
await page.click("[data-command=flat]");
say("flat", (await told("flat: done")) && (await statusIs((s) => s.flat_asked)));
const pictured = (pattern) => until(async () => pattern.test(await page.textContent("#pictures-when")));
say("pictures follow the state", await pictured(/^\d+:\d+:\d+, flat/));
say("plots have an axis", await page.$$eval(".plot .most", (marks) => marks.some((m) => /\d/.test(m.textContent))));
say("panels and eyes have a place", await until(async () => {
  const text = await page.textContent("#pictures");
  return text.includes("panel 1 (middle)") && text.includes("panel 2 (front)") && /left eye, \d+ cm away/.test(text);
}));
say("stages have a line each", (await page.textContent("#numbers .stages")).split("\n").length >= 3);
say("unused modules are no savings", !(await page.textContent("#plan")).includes("optional parts"));
await page.focus("[data-command=resume]");
await page.keyboard.press("Space");
say("resume by the keyboard", (await told("resume: done")) && (await statusIs((s) => !s.flat_asked)));
await page.click("[data-command=reload]");
say("reload", await told("reload: done"));
await choose("scene", "grey");
say("scene", (await told("scene: done")) && (await statusIs((s) => s.scene === "grey")));
await choose("scene", "no-such-scene");
say("a scene that is not there", (await told("no-such-scene")) && (await statusIs((s) => s.scene === "grey")));
await page.waitForTimeout(1500);
say("a refused name stays", (await page.inputValue("#scene-file")) === "no-such-scene");
await page.click("#place-reset");
say("old errors vanish", await until(async () => (await page.$$('[data-kind="bad"]')).length === 0 && (await page.textContent("#scene-told")) === ""));
await choose("scene", "demo");
say("scene back", (await told("scene: done")) && (await statusIs((s) => s.scene === "demo")));
// The place, the model, a playlist.
await page.fill("#p-right", "60");
await page.waitForTimeout(1500);
say("not moved while typing", (await now()).placing.offset_m[1] === 0);
await page.keyboard.press("Enter");
say("moved at once", (await statusIs((s) => Math.abs(s.placing.offset_m[1] - 0.06) < 1e-9)) &&
  (await until(async () => (await page.textContent("#placed")).includes("place: done"))));
await page.fill("#p-turntable", "6");
await page.keyboard.press("Tab");
say("turntable", await statusIs((s) => s.placing.turntable_per_min === 6 && Math.abs(s.placing.offset_m[1] - 0.06) < 1e-9));
const scales = [];
for (const scale of ["2", "0.5", "1.5", "1.2345"]) {
  await page.fill("#p-scale", scale);
  await page.keyboard.press("Enter");
  scales.push(await statusIs((s) => s.placing.scale === Number(scale)));
}
say("any scale", scales.every(Boolean));
await page.fill("#p-scale", "1001");
await page.keyboard.press("Enter");
say("a scale out of range", await shows("#placed", "Scale: must be a number from 0.001 to 1000") && (await now()).placing.scale === 1.2345);
await page.click("#place-reset");
say("as configured", await statusIs((s) => s.placing.turntable_per_min === 0 && s.placing.offset_m[1] === 0));
await page.evaluate(() => {
  window.texts = [];
  new MutationObserver(() => window.texts.push(document.getElementById("model-told").textContent)).observe(document.getElementById("model-told"), { childList: true });
});
await choose("model", "sart");
say("another model", (await told("model: done")) && (await statusIs((s) => s.model.startsWith("sart"))));
await choose("model", "fast");
say("the model back", (await told("model: done")) && (await statusIs((s) => s.model.startsWith("fast"))));
say("loading is told", (await page.evaluate(() => window.texts)).some((text) => /^(loading|testing).* … \d+ s$/.test(text)));
await choose("scene", playlist);
say("a playlist", (await told("scene: done")) && (await statusIs((s) => s.playlist && s.playlist.entries.length === 2 && s.content.includes("flat (1 of 2)"))) &&
  (await until(async () => (await page.textContent("#list-told")).includes("1 of 2"))));
await page.click("[data-command=next]");
say("the next one", (await told("next: done")) && (await statusIs((s) => s.content.includes("grey (2 of 2)"))));
await choose("scene", "demo");
say("from a playlist to a scene", (await told("scene: done")) && (await statusIs((s) => s.scene === "demo" && !s.playlist)));
await page.click("[data-command=blackbox]");
say("black box", (await told("blackbox: done: /")) && (await page.textContent("#told")).endsWith(".mcap"));
say("log and states", await page.evaluate(() => [document.querySelectorAll("#log li").length, document.querySelectorAll("#states li").length]));

// Every control is reached by the keyboard.
await page.evaluate(() => { document.activeElement.blur(); window.scrollTo(0, 0); });
const reached = [];
for (let k = 0; k < 70; k += 1) {
  await page.keyboard.press("Tab");
  reached.push(await page.evaluate(() => document.activeElement.dataset.command ?? (document.activeElement.id || document.activeElement.textContent)));
}
say("reached by tab", reached);

// The solver dies.
process.kill((await now()).processes.find((one) => one.role === "solver").pid, "SIGKILL");
say("a fault is told", await shows("#reason", "Fault since "));
say("faults have their black box", await until(async () => /was ended by SIGKILL.*; black box: \/.*-fault-model\.mcap/.test(await page.textContent("#faulty"))));
await page.setViewportSize({ width: 1440, height: 900 });
await page.evaluate(() => window.scrollTo(0, 0));
await page.screenshot({ path: `${folder}/page-1440.png` });
await page.screenshot({ path: `${folder}/page-1440-full.png`, fullPage: true });
await page.setViewportSize({ width: 1280, height: 900 });

// The daemon hangs, dies and comes back.
await parent("freeze");
say("it says that the daemon hangs", (await until(() => page.isVisible("#gone"))) && (await shows("#state", "not responding")));
await parent("thaw");
say("it goes on when it hangs no more", await until(() => page.isHidden("#gone")));
await parent("kill");
say("it says that the daemon is gone", (await until(() => page.isVisible("#gone"))) && (await shows("#state", "no daemon")));
say("it says how to start one", (await page.textContent("#gone")).includes("sudo systemctl start phasestack"));
say("without a daemon, controls are disabled", await page.$$eval("main :is(button, input, select)", (all) =>
  all.every((control) => control.disabled && control.getAttribute("aria-pressed") !== "true")));
await page.evaluate(() => window.scrollTo(0, 0));
await page.screenshot({ path: `${folder}/page-gone.png` });
await parent("start");
say("it goes on when it is back", (await until(() => page.isHidden("#gone"))) && (await shows("#numbers", "presented")));
say("and its controls work", await page.isEnabled("[data-command=pause]"));
await statusIs((s) => s.eyes_m && s.presented > 100);
await page.waitForTimeout(8000);

// As it looks, wide and narrow; accessibility.
const narrow = await context.newPage();
await narrow.setViewportSize({ width: 390, height: 844 });
await narrow.goto(origin, { waitUntil: "commit" });
await narrow.waitForSelector("#scene option", { state: "attached" });
say("the list says that it is loading", (await narrow.textContent("#scene")).includes("loading the list"));
say("the list is soon there", await narrow.waitForSelector("#scene option[value=grey]", { state: "attached", timeout: 3000 }).then(() => true, () => false));
await narrow.waitForSelector("#pictures img[src]");
await narrow.waitForTimeout(5000);
for (const [width, target] of [[1280, page], [390, narrow]]) {
  await target.screenshot({ path: `${folder}/page-${width}.png`, fullPage: true });
  await target.screenshot({ path: `${folder}/page-${width}-top.png` });
  say(`fits ${width}`, await target.evaluate(() => document.documentElement.scrollWidth <= window.innerWidth));
  say(`pause is in the first view at ${width}`, await target.evaluate(() => {
    window.scrollTo(0, 0);
    return document.querySelector("[data-command=pause]").getBoundingClientRect().bottom <= window.innerHeight;
  }));
  say(`accessible at ${width}`, await findings(await evaluated(target)));
}
say("nothing from elsewhere", elsewhere);
say("no violation of the policy, no error", violations);

await browser.close();
process.exit(0);

// The policy forbids what axe needs to run in the page: a second context ignores it, with the same cookie.
async function evaluated(target) {
  const session = await target.context().newCDPSession(target);
  await session.send("Page.setBypassCSP", { enabled: true });
  return target;
}
