// A solution as one file: its layers and its pictures are in the page.
import { Look } from "/look.js";

const read = (id) => JSON.parse(document.getElementById(id).textContent);
const image = async (url) => {
  const made = new Image();
  made.src = url;
  await made.decode();
  return made;
};

async function begin() {
  const scene = read("scene"), layers = await Promise.all(read("layers").map(image));
  const wanted = await Promise.all(read("wanted").map(image)).catch(() => {
    scene.lines.push("This browser can't read AVIF, in which the page has what was asked for.");
    return [];
  });
  if (wanted.length) scene.picture = { width: wanted[0].naturalWidth, height: wanted[0].naturalHeight };
  const look = new Look(document.querySelector("main"), scene, { title: scene.title });
  look.display.load("solved", layers);
  wanted.forEach((picture, side) => look.display.target(side, picture));
  look.$(".more").append(...scene.lines.map((line) => Object.assign(document.createElement("p"), { textContent: line })));
  Object.assign(window.phasestack, look.doors);
  look.doors.align(scene.follows);
  look.draw();
}

window.phasestack = {};
window.phasestack.ready = begin().catch((error) => {
  document.querySelector("main").textContent = `This can't be shown here: ${error.message}`;
  throw error;
});
