// node webxr.mjs URL: opens a page, says why it did not begin, and keeps it open until stdin ends.
import { opened, say } from "./chromium.mjs";

const { browser, page: newPage, errors } = await opened();
const page = await newPage();
await page.goto(process.argv[2]);
say("began", await page.evaluate(() => window.began));
say("address", page.url());
for await (const _ of process.stdin); // until it is closed
say("errors", errors);
await browser.close();
