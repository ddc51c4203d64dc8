// Debian's Chromium for a test, with playwright-core under NODE_PATH. What it asks of anywhere
// but `origin`, and every error, is kept.
import { createRequire } from "node:module";

const find = createRequire(process.env.NODE_PATH + "/x");
const { chromium } = find("playwright-core");

export const say = (what, value = null) => console.log(JSON.stringify({ what, value }));

// Wait until `holds` returns true, and return whether it did in time.
export const until = async (holds, within_ms = 60000) => {
  const end = Date.now() + within_ms;
  while (Date.now() < end) {
    if (await holds()) return true;
    await new Promise((done) => setTimeout(done, 50));
  }
  return false;
};

export async function opened({ width = 1280, height = 800, origin = null, ...more } = {}) {
  const browser = await chromium.launch({
    executablePath: "/usr/bin/chromium",
    args: ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
      "--disable-background-networking", "--disable-component-update", "--disable-sync",
      "--use-fake-device-for-media-stream"], // a test pattern
  });
  const context = await browser.newContext({ viewport: { width, height }, permissions: ["camera"], ...more });
  const elsewhere = [], errors = [];
  context.on("request", (request) => {
    const url = request.url();
    if (!/^(data|blob|file):/.test(url) && !(origin && url.startsWith(origin))) elsewhere.push(url);
  });
  const page = async () => {
    const made = await context.newPage();
    made.on("console", (message) => { if (message.type() === "error") errors.push(message.text()); });
    made.on("pageerror", (error) => errors.push(error.message));
    return made;
  };
  return { browser, context, page, elsewhere, errors };
}
