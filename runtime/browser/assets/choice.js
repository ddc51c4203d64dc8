// A list of choices, with a text field for anything else.
const OTHER = "\u2026"; // value of the entry that opens the text field

export class Choice {
  // select: the list. other: the text field, with its label in an element that is hidden until it is needed.
  constructor(select, other, { box = other.parentElement, text }) {
    Object.assign(this, { select, other, box, text, key: "" });
    box.hidden = true;
    select.addEventListener("input", () => {
      box.hidden = select.value !== OTHER;
      if (!box.hidden) other.focus();
    });
  }

  // Show groups of entries: [title, [[value, text], ...]]. A group may have no title.
  offer(groups) {
    const key = JSON.stringify(groups), chosen = this.value;
    if (key === this.key) return;
    this.key = key;
    const entry = ([value, textContent]) => Object.assign(document.createElement("option"), { value, textContent });
    this.select.replaceChildren(...groups.filter(([, entries]) => entries.length).flatMap(([label, entries]) => {
      if (!label) return entries.map(entry);
      const group = Object.assign(document.createElement("optgroup"), { label });
      group.append(...entries.map(entry));
      return [group];
    }), entry([OTHER, this.text]));
    this.value = chosen;
  }

  get isOther() {
    return this.select.value === OTHER;
  }

  get value() {
    return this.isOther ? this.other.value.trim() : this.select.value;
  }

  // Show a value, which is added to the list if it is not there.
  set value(value) {
    if (!value || (this.isOther && this.box.hidden === false && this.other.value.trim() === value)) return;
    const listed = [...this.select.options].some((option) => option.value === value);
    if (!listed) this.select.prepend(Object.assign(document.createElement("option"), { value, textContent: value }));
    this.select.value = value;
    this.box.hidden = true;
  }
}

const short = (path) => path.split("/").filter(Boolean).pop() ?? path;

// The groups of scenes in an answer to `about`.
export const scenesOf = ({ scenes, library }) => {
  const inside = scenes.filter((name) => name.startsWith("/"));
  return [["Included", scenes.filter((name) => !name.startsWith("/")).map((name) => [name, name])],
    [`In ${library}`, inside.map((path) => [path, short(path)])], ["Live", [["program", "a program that draws"]]]];
};

export const modelsOf = ({ models }) => [["", models.map((name) => [name, name])]];

// An effort such as 1/2+1 in words.
export function effortInWords(name) {
  const [, reduction, steps] = /^1\/(\d+)\+(\d+)$/.exec(name) ?? [];
  if (!steps) return name;
  const raster = { 1: "all pixels", 2: "half the rows and columns", 3: "a third of the rows and columns" }[reduction];
  return `${steps} ${steps === "1" ? "step" : "steps"} on ${raster ?? `1/${reduction} of the rows and columns`}`;
}

// Scenes besides those in the list.
export const MORE = `<details class="others"><summary>What else can be shown</summary><ul>
<li>A file or folder on the display's PC: stereo pictures and films, 3D models, Gaussian splats, data sets of views, pictures with depth, playlists.</li>
<li>All files in a folder: set <code>content.library</code> in the configuration, and this list contains them.</li>
<li>Scenes of the paper, which are not shipped. Set <code>content.file</code> to the scene's data: <span class="presets"></span>.</li>
</ul></details>`;
