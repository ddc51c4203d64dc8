// node page.mjs URL: opens a page until stdin ends.
import { opened } from "./chromium.mjs";

const { browser, page: newPage } = await opened();
const page = await newPage();
page.on("pageerror", (error) => console.error(error.message));
await page.goto(process.argv[2]);
for await (const _ of process.stdin); // until it is closed
await browser.close();
