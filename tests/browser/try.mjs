// node try.mjs URL FOLDER: `phasestack try` in Chromium; prints a line of JSON for each thing tried.
import { opened, say, until } from "./chromium.mjs";

const [, , url, folder] = process.argv;
const origin = new URL(url).origin, token = new URL(url).searchParams.get("token");
const { browser, context, page: newPage, elsewhere, errors } = await opened({ origin, width: 640, height: 480 });
const ask = (name) => fetch(`${origin}/now/${name}`, { headers: { Authorization: `Bearer ${token}` } });
// Once more, as browsers do: on a busy machine, the server may have closed the idle connection that is used again.
const now = async (name) => (await ask(name).catch(() => ask(name))).json();
const status = () => now("status"), about = () => now("about");
const far = (a, b) => Math.hypot(...a.map((v, k) => v - b[k]));
const off = (a, b) => Math.max(far(a[0], b[0]), far(a[1], b[1]));

const arrived = async (one) => { // eyes of a head that has followed the pointer
  let before = null, eyes = null;
  await until(async () => { [before, eyes] = [eyes, await one.evaluate(() => window.phasestack.eyes())]; return before && off(before, eyes) === 0; });
  return eyes;
};

let page = await newPage();
// `deaf`: nothing from the server reaches the page. `lost`: no socket stays open.
await page.addInitScript(() => {
  window.WebSocket = class extends WebSocket {
    constructor(...where) {
      super(...where);
      window.newestSocket = this;
      if (window.lost) this.close();
      this.addEventListener("message", (event) => { if (window.deaf) event.stopImmediatePropagation(); });
    }
  };
});
for (const address of [origin, `${origin}/?token=wrong`]) {
  await page.goto(address);
  say(`no token: ${address === origin ? "none" : "another"}`, await until(async () => (await page.textContent(".starting")).includes("Open the address that phasestack try printed")));
}
errors.length = 0;
await page.goto(url);
await page.evaluate(() => window.phasestack.ready);
say("the token is not in the address", !page.url().includes("token"));
const before = await status();
await page.mouse.move(200, 150);
const eyes = await arrived(page);
say("the pointer moved the head", far(eyes[0], [0.6, -0.0315, 0]) > 0.03);
say("status has the eyes there to 1 mm", await until(async () => { const { eyes_m: found } = await status(); return found && off(found, eyes) < 0.001; }));
say("another solution", await until(async () => (await status()).solution > before.solution));
say("and the page shows it", await until(() => page.evaluate(() => /is where/.test(document.querySelector(".head").textContent))));
const size = await page.evaluate(() => window.phasestack.picture(0, 320, 180).length);
say("the picture is one", size > 5000);
say("figures are told", await until(async () => /[\d.]+ refreshes per second/.test(await page.textContent(".figures"))));
await page.screenshot({ path: `${folder}/try.png` });

const light = () => page.textContent(".light");
say("light has a figure", await until(async () => /\d dB/.test(await light())));
await page.mouse.move(260, 200);
say("a moved head has no old figure", await until(async () => !/\d dB/.test(await light()), 5000));
say("and then its own", await until(async () => /\d dB/.test(await light())));
say("the status and the page agree", await until(async () => (await light()).includes(`${(await status()).light_db?.toFixed(1)} dB`)));
const figure = async () => Number(/measured (\d+) s ago/.exec(await light())?.[1]);
await page.evaluate(() => { window.deaf = true; });
const [age] = [await until(async () => (await figure()) >= 2) && await figure()];
say("a figure's age ticks on the page", await until(async () => (await figure()) > age, 20000));
const at = (share) => page.evaluate((x) => { window.phasestack.setHead([0, x, 0]); return document.querySelector(".light").textContent; }, share);
say("a head that moves has no figure, whatever the server says", await until(async () => !/\d dB/.test(await at(0.05)), 2000));
const notice = () => page.evaluate(() => document.querySelector(".notice:not([hidden])")?.textContent ?? "");
await page.evaluate(() => { [window.deaf, window.lost] = [false, true]; window.newestSocket.close(); });
say("a lost connection is tried again", await until(async () => (await notice()).includes("Trying again")) && (await light()) === "");
await context.setOffline(true);
say("and has ended after some seconds", await until(async () => (await notice()).includes("has ended")));
await context.setOffline(false);
await page.evaluate(() => { window.lost = false; });
say("and is there again", await until(async () => (await notice()) === "" && /\d dB/.test(await light())));
await page.evaluate(() => window.phasestack.build({ lines: 0.3 }));
say("imperfect panels have no figure of their own", await until(async () => (await light()).includes("for ideal panels")) && await page.isChecked("[data-key=pupil]"));
await page.evaluate(() => document.querySelector(".built button").click()); // drawing keeps the page too busy for a pointer
await page.uncheck("[data-key=pupil]");
say("and are ideal again", await until(async () => /\d dB/.test(await light()) && !(await light()).includes("ideal")));
await page.click("[data-mode=parallel]");
for (const [width, height] of [[1000, 900], [390, 844]]) {
  await page.setViewportSize({ width, height });
  say(`the figure stays in view at ${width} pixels`, await until(() => page.evaluate(() => {
    const built = document.querySelector(".built"), light = document.querySelector(".light");
    built.open = true;
    built.scrollIntoView({ block: "center" });
    const { left, top } = light.getBoundingClientRect();
    return document.elementFromPoint(left + 5, top + 5) === light;
  })));
  say(`side by side at ${width} pixels`, await until(() => page.evaluate(() => [...document.querySelectorAll(".names span")].map((one) => one.style.left).join() === "25%,75%")));
  await page.screenshot({ path: `${folder}/built-${width}.png` });
}
await page.evaluate(() => { document.querySelector(".built").open = false; });
await page.setViewportSize({ width: 640, height: 480 });
await page.click("[data-mode=left]");
for (const wrong of ["-3", "0", "500", ""]) {
  await page.fill("[name=ipd_mm]", wrong);
  await page.keyboard.press("Enter");
  say(`eyes apart by ${wrong} mm`, (await page.inputValue("[name=ipd_mm]")) === "63" && (await page.textContent(".told")).includes("Distance between eyes: must be a number from 45 to 80"));
}
await page.mouse.move(260, 210);
const spread = () => page.evaluate(() => { // widths of the display's left and right halves, as seen by the head
  const eye = window.phasestack.eyes().reduce((a, b) => a.map((v, k) => (v + b[k]) / 2)), at = (y) => Math.atan2(y - eye[1], eye[0]);
  const gaze = at(0), on = (y) => Math.tan(at(y) - gaze);
  return [-on(-0.26), on(0.26)];
});
await page.mouse.move(40, 200);
for (let k = 0; k < 10; k += 1) await page.mouse.wheel(0, -200);
await arrived(page);
const [one, two] = await spread();
say("a near head aside sees no sliver", Math.max(one, two) < 3 * Math.min(one, two));
say("both eyes are described", await page.evaluate(() => ["left", "right"].every((side) => {
  document.querySelector(`[data-mode=${side}]`).click();
  return document.querySelector(".hint").textContent.includes(`the ${side} eye sees`);
})));
await page.click("[data-mode=parallel]");
await page.click(".switches button");
await page.mouse.move(260, 200);
await page.click("[data-mode=target]");
say("what was asked for is shown", await until(() => page.evaluate(() => / dB against/.test(document.querySelector(".light").textContent))));
await page.screenshot({ path: `${folder}/target.png` });
say("for this head", await until(async () => (await page.textContent(".head")) === "Measured for this position of the head."));
await page.mouse.move(400, 120);
say("another head has another target", await until(() => page.evaluate(() => !document.querySelector(".notice").hidden), 5000)
  && await until(async () => (await page.textContent(".head")) === "Measured for this position of the head."));
await page.click("[data-mode=left]");
const solved = (await status()).solution;
await page.mouse.move(220, 160);
say("and the newest again", await until(async () => (await status()).solution > solved && /is where/.test(await page.textContent(".head"))));

// A status from before the click that comes after it does not undo it.
let asked, release;
const old = new Promise((done) => { asked = done; }), clicked = new Promise((done) => { release = done; });
await page.route("**/now/status", async (route) => {
  const response = await route.fetch();
  asked();
  await clicked;
  await route.fulfill({ response });
}, { times: 1 });
await old;
await page.check("[name=held]");
say("the solver is held", await until(async () => (await status()).paused));
await page.evaluate(() => {
  window.stayed = true;
  const watch = () => { window.stayed &&= document.querySelector("[name=held]").checked; if (window.watched !== "enough") requestAnimationFrame(watch); };
  watch();
});
release();
await page.waitForResponse("**/now/status");
await page.waitForTimeout(300);
say("an old status does not undo it", await page.evaluate(() => { window.watched = "enough"; return window.stayed; }));
const held = (await status()).solution;
await page.mouse.move(420, 300);
await until(async () => off((await status()).eyes_m, await page.evaluate(() => window.phasestack.eyes())) < 0.001);
say("while alignment goes on", await until(async () => (await status()).state === "tracking") && (await status()).solution === held);
await page.uncheck("[name=held]");
await page.check("[name=lost]");
say("eyes lost: flat", await until(async () => (await status()).state === "flat"));
await page.screenshot({ path: `${folder}/lost.png` });
await page.uncheck("[name=lost]");
say("and back", await until(async () => (await status()).state === "tracking"));
say("the list has what works", await page.$$eval("[name=scene] option", (options) => options.map((o) => o.value)));
await page.selectOption("[name=scene]", "\u2026");
await page.fill("[name=scene_file]", "no-such-scene");
await page.keyboard.press("Enter");
say("a scene that is not there", await until(async () => (await page.textContent(".told")).includes("no-such-scene")));
await until(async () => /\d dB/.test(await light()));
const chosen = await page.evaluate(() => { // the page has not heard of it yet
  const list = document.querySelector("[name=scene]");
  list.value = "texture";
  list.dispatchEvent(new Event("input", { bubbles: true }));
  list.dispatchEvent(new Event("change", { bubbles: true }));
  return [".light", ".notice"].map((name) => document.querySelector(name).textContent);
});
say("a scene that is loading has no figure", !/\d dB/.test(chosen[0]) && chosen[1].includes("Loading the scene texture"));
say("another scene", await until(async () => (await status()).scene === "texture"));
say("and then a picture", await until(async () => (await notice()) === ""));
say("a new scene has no old figure", (await status()).light_db === null || (await status()).light_age_s < 2);
await page.click("[data-mode=target]");
say("the target is the new scene's", await until(async () => (await page.textContent(".head")) === "Measured for this position of the head."));
await page.screenshot({ path: `${folder}/target-texture.png` });
await page.click("[data-mode=left]");

const other = await newPage();
await other.goto(origin);
await other.evaluate(() => window.phasestack.ready);
await other.mouse.move(100, 100);
const first = await page.evaluate(() => window.phasestack.eyes());
await new Promise((done) => setTimeout(done, 500));
say("another page looks on", off((await status()).eyes_m, first) < 0.001);
await page.close();
say("and takes over", await until(async () => { const s = await status(); return s.eyes_m && off(s.eyes_m, await other.evaluate(() => window.phasestack.eyes())) < 0.001 && far(s.eyes_m[0], first[0]) > 0.01; }));

const states = new Set();
await other.close();
say("nobody: held, then flat", await until(async () => { states.add((await status()).state); return states.has("flat"); }) && states.has("holding"));
page = await newPage();
await page.goto(origin);
await page.evaluate(() => window.phasestack.ready);
say("back: tracking", await until(async () => (await status()).state === "tracking"));
const gap = async (text) => { await page.fill("[name=gap_mm]", text); await page.keyboard.press("Enter"); };
const refused = [];
for (const wrong of ["0", "-5", "10000"]) {
  await gap(wrong);
  refused.push(await page.inputValue("[name=gap_mm]") === "60" && (await page.textContent(".told")).includes("must be a number from 1 to 500"));
}
say("a gap out of range is refused", refused.every(Boolean));
await until(async () => (await page.textContent(".figures")).includes("refreshes per second"));
await gap("40");
say("it restarts, and the page says so", await until(async () => (await page.textContent(".notice")).includes("Restarting with a gap of 40 mm"), 5000) && !/\d dB/.test(await light()));
let kept = true;
const emptied = async () => (kept &&= (await page.inputValue("[name=scene]")) === "texture" && (await page.textContent(".figures")).length > 20);
await until(async () => { await emptied(); return (await about()).stack?.x_m[2] === 0.04; }, 120000);
say("while the rest of the page stays", kept);
say("another gap", await until(async () => (await about()).stack?.x_m[2] === 0.04, 120000));
await page.check("[name=camera]");
say("its camera is the sensor", await until(() => page.evaluate(() => /no viewer/.test(document.querySelector(".found figcaption").textContent)), 120000)
  && await until(async () => (await status()).eyes_m === null));
await page.screenshot({ path: `${folder}/camera.png` });
await page.uncheck("[name=camera]");
say("and the pointer again", await until(async () => (await status()).state === "tracking", 120000));
say("and the scene stays", await until(async () => { const s = await status(); return s.scene === "texture" && s.state === "tracking"; }, 120000));
say("elsewhere", elsewhere);
say("errors", errors.filter((text) => !/status of (503|409)|DISCONNECTED/.test(text)));
await browser.close();
