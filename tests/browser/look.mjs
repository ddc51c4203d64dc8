// node look.mjs FILE WIDTH HEIGHT MOVE FOLDER: what `viewer.html` shows at rest, moved aligned, and moved as the panels stand.
import { writeFileSync } from "node:fs";
import { opened, say } from "./chromium.mjs";

const [, , file, width, height, move, folder] = process.argv;
const { browser, page: newPage, elsewhere, errors } = await opened();
const page = await newPage();
await page.goto(`file://${file}`);
await page.evaluate(() => window.phasestack.ready);
for (const [name, head, aligned] of [["rest", [0, 0, 0], true], ["aligned", JSON.parse(move), true], ["standing", JSON.parse(move), false]]) {
  await page.evaluate(([at, on]) => { window.phasestack.setHead(at); window.phasestack.align(on); }, [head, aligned]);
  for (const eye of [0, 1]) {
    const url = await page.evaluate((how) => window.phasestack.picture(...how), [eye, Number(width), Number(height)]);
    writeFileSync(`${folder}/${name}-${eye}.png`, Buffer.from(url.split(",")[1], "base64"));
  }
}
for (const [n, url] of (await page.evaluate(async () => Promise.all(JSON.parse(document.getElementById("layers").textContent).map(async (layer) => {
  const image = Object.assign(new Image(), { src: layer });
  await image.decode();
  const canvas = Object.assign(document.createElement("canvas"), { width: image.naturalWidth, height: image.naturalHeight });
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas.toDataURL();
})))).entries()) writeFileSync(`${folder}/decoded-${n}.png`, Buffer.from(url.split(",")[1], "base64"));
await page.evaluate(() => window.phasestack.setHead([0, 0, 0]));
if (await page.$("[data-mode=target]")) say("told", await page.waitForFunction(() => /\d dB/.test(document.querySelector(".light").textContent), null, { timeout: 120000 })
  .then(() => page.textContent(".light")));
const modes = {};
for (const mode of await page.evaluate(() => [...document.querySelectorAll("[data-mode]")].map((b) => b.dataset.mode))) {
  await page.click(`[data-mode=${mode}]`);
  await page.waitForTimeout(300);
  modes[mode] = (await page.screenshot({ path: `${folder}/mode-${mode}.png` })).length;
}
say("modes", modes);
await page.click("[data-mode=left]");
await page.keyboard.press("ArrowRight");
await page.waitForFunction(() => document.querySelector(".head").textContent.includes("5 mm to the right"), null, { timeout: 60000 });
say("keys move the head", true);
await page.setViewportSize({ width: 390, height: 800 });
await page.waitForTimeout(500);
say("fits a phone", await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth));
say("elsewhere", elsewhere);
say("errors", errors);
await browser.close();
