// node built.mjs FILE WIDTH HEIGHT BUILT FOLDER: the left eye's picture of `viewer.html` for each of a list of imperfect
// panels, and the light that the page tells for the last.
import { writeFileSync } from "node:fs";
import { opened, say } from "./chromium.mjs";

const [, , file, width, height, built, folder] = process.argv;
const { browser, page: newPage, errors } = await opened({ width: 480, height: 640 }); // small, because software draws it
const page = await newPage();
await page.goto(`file://${file}`);
await page.evaluate(() => window.phasestack.ready);
for (const [k, one] of JSON.parse(built).entries()) {
  const url = await page.evaluate(([how, w, h]) => (window.phasestack.build(how), window.phasestack.picture(0, w, h)), [one, Number(width), Number(height)]);
  writeFileSync(`${folder}/built-${k}.png`, Buffer.from(url.split(",")[1], "base64"));
}
await page.click("[data-mode=left]");
await page.evaluate(() => { document.querySelector(".built").open = true; });
await page.waitForFunction(() => /\d dB/.test(document.querySelector(".light").textContent), null, { timeout: 300000 });
say("told", await page.textContent(".light"));
say("sliders", await page.evaluate(() => [...document.querySelectorAll(".built input")].map((one) => Number(one.value))));
say("errors", errors);
await browser.close();
