// Script for a self-contained page that shows one solution, using embedded layers and target pictures.
import { Look } from "/look.js";

const read = (id) => JSON.parse(document.getElementById(id).textContent);
const image = async (url) => {
  const made = new Image();
  made.src = url;
  await made.decode();
  return made;
};

const halves = async (text) => {
  const deflated = new Blob([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))]).stream();
  return new Uint16Array(await new Response(deflated.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
};

async function begin() {
  const scene = read("scene"), layers = await Promise.all(read("layers").map(image));
  const wanted = await Promise.all(read("wanted").map(image)).catch(() => {
    scene.lines.push("This browser cannot decode AVIF, so this page has no targets.");
    return [];
  });
  if (wanted.length) scene.picture = { width: wanted[0].naturalWidth, height: wanted[0].naturalHeight };
  const look = new Look(document.querySelector("main"), scene, { title: scene.title });
  look.display.load("solved", layers);
  if (scene.relief) look.display.unfold(await halves(scene.relief.deflated), scene.relief.size);
  wanted.forEach((picture, side) => look.display.target(side, picture));
  look.$(".more").append(...scene.lines.map((line) => Object.assign(document.createElement("p"), { textContent: line })));
  Object.assign(window.phasestack, look.doors);
  look.doors.align(scene.follows);
  look.draw();
}

window.phasestack = {};
window.phasestack.ready = begin().catch((error) => {
  document.querySelector("main").textContent = `This browser cannot show the page: ${error.message}`;
  throw error;
});
