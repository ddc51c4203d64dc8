// node value.mjs FILE: a page's `value`.
import { opened, say } from "./chromium.mjs";

const { browser, page: newPage, errors } = await opened();
const page = await newPage();
await page.goto(`file://${process.argv[2]}`);
say("value", await page.waitForFunction(() => window.value, null, { timeout: 30000 }).then((found) => found.jsonValue()).catch(String));
say("errors", errors);
await browser.close();
