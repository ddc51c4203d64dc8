// node two.mjs URL FOLDER: two pages of `phasestack try` in Chromium are two people; prints a line of JSON for each thing.
import { opened, say, until } from "./chromium.mjs";

const [, , url, folder] = process.argv;
const origin = new URL(url).origin, token = new URL(url).searchParams.get("token");
const { browser, page: newPage, elsewhere, errors } = await opened({ origin, width: 640, height: 480 });
const ask = () => fetch(`${origin}/now/status`, { headers: { Authorization: `Bearer ${token}` } });
const status = async () => (await ask().catch(ask)).json();
const served = async () => ((await status()).people ?? []).length;
const who = (page) => page.textContent(".who");
const measured = (page) => until(async () => (await page.textContent(".head")) === "Measured for this position of the head.");

const first = await newPage();
await first.goto(url);
await first.evaluate(() => window.phasestack.ready);
say("one person", (await until(async () => (await who(first)).startsWith("You are person 1. Open"))) && (await served()) === 1);
const second = await newPage();
await second.goto(origin);
await second.evaluate(() => window.phasestack.ready);
say("then two", await until(async () => (await served()) === 2));
say("each page says who it is", await until(async () => (await who(first)) === "You are person 1." && (await who(second)) === "You are person 2."));
await second.mouse.move(350, 240);
for (const [page, name] of [[first, "first"], [second, "second"]]) {
  await page.click("[data-mode=target]");
  say(`the ${name} one has targets`, await measured(page));
  say(`${name} eyes`, await page.evaluate(() => window.phasestack.eyes()));
  await page.screenshot({ path: `${folder}/two-target-${name}.png` });
  await page.click("[data-mode=left]");
}
await until(async () => (await status()).eyes_label === "rested");
for (const [page, name] of [[first, "first"], [second, "second"]]) {
  say(name, await page.evaluate(() => window.phasestack.picture(0, 320, 180)));
  await page.screenshot({ path: `${folder}/two-${name}.png` });
}
await first.selectOption("[name=seen_by]", { label: "person 2" });
say("the second's, on the first page", await first.evaluate(() => window.phasestack.picture(0, 320, 180)));
say("both heads in a plan", await first.evaluate(() => document.querySelectorAll("[data-axis='1'] circle.left:not(.sure)").length) === 2);
const third = await newPage();
await third.goto(origin);
await third.evaluate(() => window.phasestack.ready);
say("a third one watches", await until(async () => (await who(third)).startsWith("This page only watches")));
await third.close();
await second.close();
say("one again", await until(async () => (await served()) === 1 && (await who(first)).startsWith("You are person 1. Open")));
say("elsewhere", elsewhere);
say("errors", errors.filter((text) => !/status of (503|409)/.test(text)));
await browser.close();
