// node focus.mjs FILE WIDTH HEIGHT MM FOLDER: the left eye's picture of `viewer.html`, focused at each of a list of distances.
import { writeFileSync } from "node:fs";
import { opened, say } from "./chromium.mjs";

const [, , file, width, height, mm, folder] = process.argv;
const { browser, page: newPage, errors } = await opened({ width: 480, height: 640 }); // small, because software draws it
const page = await newPage();
await page.goto(`file://${file}`);
await page.evaluate(() => window.phasestack.ready);
for (const [k, one] of JSON.parse(mm).entries()) {
  const url = await page.evaluate(([at, w, h]) => (window.phasestack.focus(at), window.phasestack.picture(0, w, h, 4)), [one, Number(width), Number(height)]);
  writeFileSync(`${folder}/focus-${k}.png`, Buffer.from(url.split(",")[1], "base64"));
}
await page.click("[data-mode=left]");
await page.evaluate(() => { const slider = document.querySelector("[data-focus]"); slider.value = -40; slider.dispatchEvent(new Event("input")); });
say("slider", await page.evaluate(() => [document.querySelector("[data-focus]").nextElementSibling.textContent, document.querySelector("[data-key=pupil]").checked]));
await page.screenshot({ path: `${folder}/page.png` });
say("errors", errors);
await browser.close();
