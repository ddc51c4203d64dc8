// User interface for a page that shows a display: the head is moved with the pointer or keys, and there are viewing
// modes and figures.
import { Display, IDEAL, alignment, unaligned, panelDraws, drawPlan, middle, moved, fieldOfView, centre } from "/display.js";

const MODES = [ // key, name, group, hint
  ["wiggle", "Wiggle", "Eyes", "Alternates between the two eyes' pictures. The nearest parts jump the most."],
  ["parallel", "Side by side", "Eyes", "Look through the screen. The left picture is for the left eye."],
  ["crossed", "Crossed", "Eyes", "Cross your eyes. The left picture is for the right eye."],
  ["anaglyph", "Red and cyan", "Eyes", "For glasses with a red left lens and a cyan right lens."],
  ["left", "Left eye", "Eyes", "What the left eye sees. Move the head to see around things."],
  ["right", "Right eye", "Eyes", "What the right eye sees. Move the head to see around things."],
  ["panels", "Each panel", "Panels", "What each panel shows, from rear to front."],
  ["apart", "Drawn apart", "Panels", "Shows one point of the picture and its rays to both eyes. Point elsewhere to choose another."],
  ["target", "Target", "Check", "What each eye should see from the head position the layers were solved for."],
  ["difference", "Difference × 8", "Check", "What each eye sees minus what it should see, from the head position the layers were solved for. Black is perfect."],
];
const KEYS = { ArrowLeft: [0, -1, 0], ArrowRight: [0, 1, 0], ArrowUp: [0, 0, 1], ArrowDown: [0, 0, -1], "+": [-2, 0, 0], "-": [2, 0, 0] };
// Without a GPU, drawing takes processor time away from the solver, so while the head moves, pictures are drawn less
// often and smaller.
const SOFTWARE = { rays: 1, coarse: 0.5, frame_ms: 60 };
// STEP_M: how far each key press moves the head. REACH_M: how far the head moves when the pointer crosses the whole
// picture.
const STEP_M = 0.005, REACH_M = [0.5, 0.3];
// SAMPLED: light is measured at every SAMPLED-th pixel in both directions.
const REST_MS = 200, REST_RAYS = 5, STRIPS = 12, WIGGLE_MS = 280, REPORT_MS = 120, SAMPLED = 12;
// Sliders for panels "as built": key in `built`, label, greatest value, step, factor from the slider's value to the key's.
const BUILT = [
  ["shift_px", "front panel off to the right, pixels", 3, 0.25, 1],
  ["short_deg", "full white short of 90°, degrees", 20, 1, 1],
  ["dark_deg", "black that turns, degrees", 12, 0.5, 1],
  ["gamma", "grey curves off by a gamma, %", 30, 1, 0.01],
  ["black", "black as a share of white, %", 2, 0.1, 0.01],
  ["lines", "black lines between subpixels, % of the area", 60, 5, 0.01],
];
const PAGE = `
<div class="stage"><canvas tabindex="0" aria-label="What the eyes see. Arrow keys move the head; + and - move it nearer and farther."></canvas>
<svg class="over" aria-hidden="true"></svg><div class="names" aria-hidden="true"></div><p class="notice" role="status" hidden></p></div>
<aside><h1></h1><p class="how">Move your head with the pointer, a finger or the arrow keys. Scroll to move it nearer or farther.</p><div class="now"><p class="light"></p><p class="head" role="status"></p></div><div class="first"></div><div class="modes"></div><p class="hint"></p>
<div class="switches"><label><input type="checkbox" data-key="aligned" checked> outer panels follow the head</label>
<label><input type="checkbox" data-key="pupil"> pupils 4 mm wide</label>
<label class="slider"><span>focus, mm in front of the middle panel</span><input type="range" data-focus min="-150" max="150" step="5" value="0"><output>0</output></label><button type="button" class="quiet">Reset head</button></div>
<details class="built"><summary>As built</summary><p class="how">What imperfect panels would show. <code>phasestack tolerance</code> measures what each costs.</p><button type="button" class="quiet">Make the panels ideal</button></details>
<div class="point"></div>
<div class="views"><figure><svg data-axis="1" viewBox="0 0 320 170" role="img" aria-label="Eyes and panels from above"></svg><figcaption>from above</figcaption></figure>
<figure><svg data-axis="2" viewBox="0 0 320 170" role="img" aria-label="Eyes and panels from the side"></svg><figcaption>from the side</figcaption></figure></div>
<div class="more"></div></aside>`;

const node = (name, text = "", kind = "") => Object.assign(document.createElement(name), { textContent: text, className: kind });
const mm = (metres) => Math.round(Math.abs(metres) * 1000);

export class Look {
  // scene: `stack`, `fov_deg`, and `eyes_m`, the eyes that the layers were solved for.
  // eyesAt: function that returns both eyes, given how far the head is displaced.
  // onTheWay: function that returns how far the head is displaced now while it moves to a given displacement.
  constructor(root, scene, { title, eyesAt = (head) => moved(scene.eyes_m, head), onTheWay = (head) => head }) {
    root.innerHTML = PAGE;
    this.$ = (query) => root.querySelector(query);
    Object.assign(this, { scene, stack: scene.stack, eyesAt, onTheWay });
    this.canvas = this.$("canvas");
    this.display = new Display(this.canvas, this.stack);
    Object.assign(this, { mode: "parallel", head: [0, 0, 0], aligned: true, pupil: false, focus_mm: 0, point: [0, 0], rays: 3, coarse: 1, frame_ms: 0, painted_ms: 0, reported_ms: 0, frames: 0 });
    if (this.display.software) Object.assign(this, SOFTWARE);
    this.flatness = 0;
    this.between = null; // all people's eyes that the layers were solved for, and that they are aligned to; null: `eyes`
    this.others = []; // eyes of the people whose pictures are not drawn
    this.state = ""; // why the picture differs from the two eyes' targets
    this.live = false; // true if the daemon measures the light, and calls `tell`
    this.onhead = () => {}; // called after the head has moved
    this.onframe = () => {}; // called after a picture has been drawn
    this.onchange = () => {}; // called when the picture must be drawn again
    this.onmode = () => {}; // called when a mode is chosen, with true if it needs target pictures
    this.$("h1").textContent = title;
    this.$(".light").hidden = !scene.picture;
    root.style.setProperty("--aspect", this.stack.width_m / this.stack.height_m);
    this.#modes();
    this.#controls();
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.canvas.addEventListener("webglcontextlost", () => (this.$(".hint").textContent = "The browser lost its graphics context. Reload the page."));
  }

  get eyes() {
    return this.eyesAt(this.onTheWay(this.head));
  }

  #draws(aligned = this.alignment) {
    return panelDraws(this.stack, aligned, this.display.solved_px, this.flatness);
  }

  get alignment() {
    if (!this.aligned || !this.scene.eyes_m) return unaligned(this.stack);
    return alignment(this.stack, ...(this.between ?? [this.scene.eyes_m, this.eyes]));
  }

  // Change the panels' positions. Layers for the new positions are loaded later.
  turnTo(stack) {
    this.stack = this.scene.stack = this.display.stack = stack;
    this.scene.eyes_m = null;
  }

  moveTo(head) {
    this.head = head;
    this.onhead();
    this.draw();
  }

  // Focus the pupils, which get their width, on a plane `mm` in front of the centre panel.
  focus(mm) {
    const slider = this.$("[data-focus]");
    slider.value = this.focus_mm = mm;
    slider.nextElementSibling.textContent = mm;
    this.$("[data-key=pupil]").checked = this.pupil = true;
    this.draw();
  }

  // Show a message over the picture. If `text` is empty, hide it.
  notice(text) {
    const box = this.$(".notice");
    if (box.textContent !== text) box.textContent = text;
    box.hidden = !text;
  }

  // Redraw at the next frame, and then again with more rays if nothing changes for REST_MS.
  draw() {
    this.moving = performance.now();
    this.fresh = true;
    if (this.isMeasured && !this.live) this.$(".light").textContent = this.display.targets[0] ? "…" : "";
    [this.isMeasured, this.isReported] = [false, false];
    this.onchange();
    this.next ??= requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.next = null;
    clearTimeout(this.turn);
    if (this.before !== undefined) { // between consecutive frames, adapt rays and resolution to the machine's speed
      this.pace = 0.8 * (this.pace ?? 30) + 0.2 * (now - this.before);
      if (this.pace > 50 && this.rays > 1) [this.rays, this.pace] = [this.rays - 1, 30];
      else if (this.pace > 50 && this.coarse > 0.6) [this.coarse, this.pace] = [this.coarse * 0.7, 30];
      else if (this.pace < 20 && this.rays < 3 && !this.display.software) [this.rays, this.pace] = [this.rays + 1, 30];
    }
    this.before = undefined;
    if (this.fresh && now - this.painted_ms < this.frame_ms) return void (this.next = requestAnimationFrame((then) => this.#frame(then)));
    this.painted_ms = now;
    this.frames += 1;
    const resting = !this.fresh && performance.now() - this.moving > REST_MS, { width, height, resized } = this.#fitted(resting);
    this.fresh = false;
    const aligned = this.mode === "difference" ? unaligned(this.stack) : this.alignment, draws = this.#draws(aligned);
    this.quick = !resting && this.rays === 1 && this.flatness === 0 && !this.pupil && !this.display.isBuilt && !["panels", "apart", "target", "difference"].includes(this.mode) ? draws : null;
    if (!this.quick) this.display.show(draws);
    const turning = this.mode === "wiggle";
    if (!resting || turning || ["panels", "apart", "target"].includes(this.mode)) {
      this.strip = undefined;
      this.#paint(width, height, this.rays);
      this.onframe();
      if (!this.isReported && (resting || now - this.reported_ms > REPORT_MS)) this.#report(aligned.limited), (this.reported_ms = now);
      if (!resting) {
        this.before = now;
        this.next = requestAnimationFrame((then) => this.#frame(then));
        return;
      }
      if (!this.isMeasured) this.#measure();
      const again = () => (this.next ??= requestAnimationFrame((then) => this.#frame(then)));
      if (turning) this.turn = setTimeout(again, WIGGLE_MS - (performance.now() % WIGGLE_MS) + 1);
      return;
    }
    if (!this.isReported) this.#report(aligned.limited);
    const g = this.display.g, rows = Math.ceil(height / STRIPS);
    if (resized) this.#paint(width, height, 1);
    this.strip ??= 0;
    g.enable(g.SCISSOR_TEST);
    g.scissor(0, height - (this.strip + 1) * rows, width, rows);
    this.#paint(width, height, REST_RAYS);
    g.disable(g.SCISSOR_TEST);
    this.strip += 1;
    if (this.strip < STRIPS) this.next = requestAnimationFrame((then) => this.#frame(then));
    else {
      this.strip = undefined;
      this.#measure();
    }
  }

  #fitted(resting) {
    const scale = Math.min(window.devicePixelRatio || 1, 2) * (resting ? 1 : this.coarse), { clientWidth, clientHeight } = this.canvas;
    const width = Math.max(16, Math.round(clientWidth * scale)), height = Math.max(16, Math.round(clientHeight * scale));
    const resized = this.canvas.width !== width || this.canvas.height !== height; // resizing clears the canvas
    if (resized) Object.assign(this.canvas, { width, height });
    return { width, height, resized };
  }

  #picture(width, height) {
    return { width, height, fov_deg: fieldOfView(this.stack, this.eyes, Math.hypot(...middle(this.eyesAt([0, 0, 0]))), width, height) };
  }

  get #focus_m() {
    return centre(this.stack) + this.focus_mm / 1000;
  }

  #paint(width, height, rays) {
    const { display, mode } = this, g = display.g, pupil_mm = this.pupil ? 4 : 0, focus_m = this.#focus_m;
    const checks = mode === "target" || mode === "difference", two = checks || mode === "parallel" || mode === "crossed";
    const across = two && (!checks || this.#fitsSideBySide(width, height)) ? 2 : 1, down = two && across === 1 ? 2 : 1, w = Math.floor(width / across), h = Math.floor(height / down);
    this.$(".over").replaceChildren();
    g.clearColor(0.07, 0.08, 0.1, 1);
    const sides = two ? (mode === "crossed" ? [1, 0] : [0, 1]) : [mode === "right" || (mode === "wiggle" && Math.floor(performance.now() / WIGGLE_MS) % 2) ? 1 : 0];
    if (mode === "panels" || mode === "apart") g.clear(g.COLOR_BUFFER_BIT);
    if (mode === "panels") return this.#cards(width, height);
    if (mode === "apart") return this.#apart(width, height);
    if (checks) {
      g.clear(g.COLOR_BUFFER_BIT);
      if (!display.targets[0]) return; // the target pictures have not arrived yet
      const { width: pw, height: ph } = this.scene.picture, fit = 0.97 * Math.min(w / pw, h / ph), pic = { width: Math.floor(pw * fit), height: Math.floor(ph * fit) };
      sides.forEach((side, k) => {
        const left = (k % across) * w + ((w - pic.width) >> 1), below = height - (Math.floor(k / across) + 1) * h + ((h - pic.height) >> 1);
        display.see({ eye: this.scene.eyes_m[side], picture: { ...pic, fov_deg: this.scene.fov_deg }, part: [left, below, pic.width, pic.height],
          rays, pupil_mm, side, gain: mode === "target" ? 1 : 8 });
      });
    } else if (mode === "anaglyph") {
      for (const side of [0, 1]) {
        g.colorMask(side === 0, side === 1, side === 1, true);
        display.see({ eye: this.eyes[side], picture: this.#picture(w, h), part: [0, 0, w, h], rays, pupil_mm, focus_m, quick: this.quick });
      }
      g.colorMask(true, true, true, true);
    } else {
      sides.forEach((side, k) => display.see({ eye: this.eyes[side], picture: this.#picture(w, h), rays, pupil_mm, focus_m, quick: this.quick,
        part: [(k % across) * w, height - (Math.floor(k / across) + 1) * h, w, h] }));
    }
    this.#names(mode === "anaglyph" ? [] : sides.map((side, k) => [`${side ? "right" : "left"} eye`, ((k % across) + 0.5) / across, (Math.floor(k / across) + 1) / down]));
  }

  // Return true if two target pictures can be drawn larger next to each other than one above the other.
  #fitsSideBySide(width, height) {
    const { width: pw, height: ph } = this.scene.picture;
    return Math.min(width / 2 / pw, height / ph) >= Math.min(width / pw, height / 2 / ph);
  }

  #names(names) {
    const key = JSON.stringify(names), box = this.$(".names");
    if (box.dataset.key === key) return;
    box.dataset.key = key;
    box.replaceChildren(...names.map(([text, x, y]) => {
      const name = node("span", text);
      name.style.left = `${100 * x}%`;
      name.style.bottom = `${100 * (1 - y)}%`;
      return name;
    }));
  }

  #cards(width, height) {
    const count = this.stack.x_m.length, aspect = this.stack.width_px / this.stack.height_px, gap = 12;
    const fit = (columns) => Math.min((width - gap) / columns - gap, ((height - gap) / Math.ceil(count / columns) - gap - 20) * aspect);
    const columns = [...Array(count).keys()].map((k) => k + 1).reduce((best, k) => (fit(k) > fit(best) ? k : best), 1), w = fit(columns), h = w / aspect;
    const names = this.stack.x_m.map((x, n) => {
      const left = gap + (n % columns) * (w + gap), top = gap + Math.floor(n / columns) * (h + gap + 20);
      this.display.card(n, [left, top], [w, 0], [0, h]);
      return [panelName(n, count), (left + w / 2) / width, (top + h + 22) / height];
    });
    this.#names(names);
  }

  // Return the projection for an exploded view of the panels from the upper left, where two rays cross at a point on
  // the centre panel.
  #drawnApart(width, height) {
    const { x_m, width_m, height_m } = this.stack, deep = x_m.at(-1) - x_m[0], scale = Math.min((0.56 * width) / width_m, (0.6 * height) / height_m);
    const toViewer = [(0.26 * width) / deep, (0.2 * height) / deep], origin = [0.47 * width, 0.47 * height], half = (x_m.at(-1) + x_m[0]) / 2;
    return { scale, at: (x, y, z) => [origin[0] + y * scale + (x - half) * toViewer[0], origin[1] - z * scale + (x - half) * toViewer[1]],
      inverse: (px, py, x) => [(px - origin[0] - (x - half) * toViewer[0]) / scale, (origin[1] + (x - half) * toViewer[1] - py) / scale] };
  }

  #apart(width, height) {
    const { stack, eyes } = this, { width_m, height_m, x_m } = stack, count = x_m.length, { scale, at } = this.#drawnApart(width, height);
    x_m.forEach((x, n) => this.display.card(n, at(x, -width_m / 2, height_m / 2), [width_m * scale, 0], [0, height_m * scale], n ? 0.72 : 1));
    const over = this.$(".over"), shapes = [], reference = x_m[count >> 1], deep = x_m.at(-1) - x_m[0], lines = [];
    over.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const add = (name, attributes, text = "") => {
      const made = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      made.textContent = text;
      shapes.push(made);
    };
    eyes.forEach((eye, side) => {
      const kind = side ? "right" : "left";
      const on = (x) => [1, 2].map((k) => eye[k] + (this.point[k - 1] - eye[k]) * ((x - eye[0]) / (reference - eye[0])));
      const begin = at(x_m[0], ...on(x_m[0])), ends = x_m.at(-1) + 0.42 * deep, end = at(ends, ...on(ends));
      add("line", { x1: begin[0], y1: begin[1], x2: end[0], y2: end[1], class: `ray ${kind}` });
      const codes = x_m.map((x, n) => {
        const [y, z] = on(x), [cx, cy] = at(x, y, z);
        add("circle", { cx, cy, r: 0.006 * width, class: kind });
        const u = (y / width_m + 0.5) * stack.width_px, v = (0.5 - z / height_m) * stack.height_px;
        return u >= 0 && v >= 0 && u < stack.width_px && v < stack.height_px ? this.display.codes(n, u, v) : null;
      });
      add("text", { x: end[0], y: end[1] + (side ? -0.012 : 0.03) * width, class: kind, "font-size": Math.max(12, 0.016 * width) }, `to the ${kind} eye`);
      lines.push(this.#sum(kind, codes));
    });
    over.replaceChildren(...shapes);
    this.$(".point").replaceChildren(...lines);
    this.#names(x_m.map((x, n) => [panelName(n, count), ...at(x, -0.36 * width_m, height_m / 2).map((p, k) => p / (k ? height : width))]));
  }

  // Return a line of text that gives the panel values along a ray and the resulting light.
  #sum(kind, codes) {
    const line = node("p", `${kind} eye: `, kind);
    if (codes.includes(null)) return line.append("the ray misses a panel"), line;
    const swatch = (rgb) => {
      const made = node("i");
      made.style.background = `rgb(${rgb.map(Math.round)})`;
      return made;
    };
    const seen = [0, 1, 2].map((k) => 255 * Math.sin((codes.reduce((sum, c) => sum + c[k], 0) / 255) * (Math.PI / 2)) ** 2);
    const turns = codes.map((c) => Math.round((c[1] / 255) * 90));
    codes.forEach((code, n) => line.append(n ? " + " : "", swatch(code)));
    line.append(" → ", swatch(seen), node("small", ` green: ${turns.join("° + ")}° of rotation, sin² = ${((100 * seen[1]) / 255).toFixed(0)}% of the light`));
    return line;
  }

  #report(limited) {
    this.isReported = true;
    const { eyes_m: solved } = this.scene, eyes = this.eyes;
    for (const svg of this.$(".views").querySelectorAll("svg"))
      drawPlan(svg, { stack: this.stack, eyes: [...eyes, ...this.others], solved, axis: Number(svg.dataset.axis), far_m: 0.7, sigma_m: this.sigma_m ?? 0 });
    if (this.mode !== "apart") this.$(".point").replaceChildren();
    const [x, y, z] = solved ? middle(eyes).map((v, k) => v - middle(solved)[k]) : [0, 0, 0];
    const parts = [[y, "to the right", "to the left"], [z, "up", "down"], [x, "farther", "nearer"]].filter(([v]) => mm(v));
    const where = !solved ? "" : parts.length ? `The head is ${parts.map(([v, one, other]) => `${mm(v)} mm ${v > 0 ? one : other}`).join(", ")} from where the layers were solved for` : "The head is where the layers were solved for";
    if (this.state) return void (this.$(".head").textContent = this.state);
    const limit = limited ? `; the outer panels follow only part of the way because the head is ${limited}` : "";
    this.$(".head").textContent = where && `${where}${limit}.`;
  }

  // Measure the PSNR of the light at both eyes on sampled pixels, and show it. The target pictures are treated as if
  // painted on the centre panel.
  #measure() {
    const { display, scene } = this;
    this.isMeasured = true;
    if (this.live || !display.targets[0] || this.flatness > 0) return;
    const { width, height } = scene.picture, picture = { width, height, fov_deg: scene.fov_deg };
    const columns = Math.floor(width / SAMPLED), rows = Math.floor(height / SAMPLED);
    display.show(this.#draws());
    let error = 0, counted = 0;
    for (const side of [0, 1]) {
      const how = { nominal: scene.eyes_m[side], picture, columns, rows, stride: [width / columns, height / rows].map(Math.floor), side };
      const seen = display.seen({ ...how, eye: this.eyes[side], pupil_mm: 4 }), target = display.seen({ ...how, eye: this.eyes[side], rays: 1, gain: 1 });
      for (let k = 0; k < columns * rows; k += 1) {
        if (seen[4 * k + 3] < 255) continue;
        for (let c = 0; c < 3; c += 1) error += ((seen[4 * k + c] - target[4 * k + c]) / 255) ** 2;
        counted += 3;
      }
    }
    if (!counted) return void (this.$(".light").textContent = "No ray from here crosses all panels.");
    // Subtract the error due to compressing the target pictures.
    this.tell(-10 * Math.log10(Math.max(error / counted - (scene.target_error ?? 0), 1e-9)));
  }

  // Show the PSNR of the light at both eyes, followed by `note`, or `note` alone. A live page's figure is the daemon's.
  tell(light_db, note = "") {
    const another = this.display.isBuilt || (this.live && !this.aligned);
    const words = another ? (this.live ? "for ideal panels that follow the head" : "") : light_db > 33 ? "hard to distinguish from the target" :
      light_db > 27 ? "a good picture with faint traces of the other layers" : light_db > 21 ? "obvious ghosts and coloured edges" : "the layers fall apart";
    const text = light_db === null ? note : `Light at both eyes: ${light_db.toFixed(1)} dB against the target${words && ` (${words})`}${note}.`, box = this.$(".light");
    if (box.textContent !== text) box.textContent = text;
  }

  #modes() {
    const groups = {};
    MODES.forEach(([key, name, group], k) => {
      if (group === "Check" && !this.scene.picture) return;
      const box = (groups[group] ??= node("div", "", "group"));
      const button = Object.assign(node("button", name), { type: "button", title: `key ${(k + 1) % 10}` });
      button.dataset.mode = key;
      button.addEventListener("click", () => this.choose(key));
      box.append(button);
    });
    this.$(".modes").append(...Object.entries(groups).map(([name, box]) => (box.prepend(node("span", name)), box)));
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.choose(!still ? "wiggle" : this.canvas.clientWidth >= 500 ? "parallel" : "left");
  }

  choose(mode) {
    this.mode = mode;
    for (const button of this.$(".modes").querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
    const [, , group, hint] = MODES.find(([key]) => key === mode);
    this.$(".hint").textContent = hint;
    this.onmode(group === "Check");
    this.draw();
  }

  #controls() {
    const { canvas } = this, fingers = new Map();
    const point = (event) => [event.offsetX / canvas.clientWidth - 0.5, 0.5 - event.offsetY / canvas.clientHeight];
    canvas.addEventListener("pointerdown", (event) => fingers.set(event.pointerId, event));
    for (const kind of ["pointerup", "pointercancel", "pointerleave"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = point(event), before = fingers.get(event.pointerId);
      if (this.mode === "apart") {
        const { width, height } = canvas, { inverse } = this.#drawnApart(width, height), { x_m, width_m, height_m } = this.stack;
        const at = inverse((x + 0.5) * width, (0.5 - y) * height, x_m[x_m.length >> 1]);
        this.point = at.map((v, k) => Math.max(-0.49 * [width_m, height_m][k], Math.min(0.49 * [width_m, height_m][k], v)));
        return this.draw();
      }
      const closer = this.#closer(this.head[0]);
      if (event.pointerType === "mouse") return this.moveTo([this.head[0], x * REACH_M[0] * closer, y * REACH_M[1] * closer]);
      if (!before) return;
      const [a, b] = point(before), other = [...fingers.values()].find((f) => f.pointerId !== event.pointerId);
      fingers.set(event.pointerId, event);
      if (!other) return this.moveTo([this.head[0], this.head[1] + (x - a) * REACH_M[0] * closer, this.head[2] + (y - b) * REACH_M[1] * closer]);
      const apart = (one) => Math.hypot(one.offsetX - other.offsetX, one.offsetY - other.offsetY);
      this.#nearer((apart(before) - apart(event)) / canvas.clientWidth);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#nearer(event.deltaY / 2000);
    }, { passive: false });
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
      const step = KEYS[event.key], mode = MODES[(Number(event.key) + 9) % 10];
      if (step) this.moveTo(this.head.map((v, k) => v + step[k] * STEP_M * (event.shiftKey ? 4 : 1)));
      else if (event.key === "a") this.$("[data-key=aligned]").click();
      else if (event.key === "p") this.$("[data-key=pupil]").click();
      else if (event.key === "Home") this.moveTo([0, 0, 0]);
      else if (/^\d$/.test(event.key) && this.$(`[data-mode=${mode[0]}]`)) this.choose(mode[0]);
      else return;
      event.preventDefault();
    });
    this.$("[data-focus]").addEventListener("input", ({ target }) => this.focus(Number(target.value)));
    for (const box of this.$(".switches").querySelectorAll("input[type=checkbox]"))
      box.addEventListener("change", () => {
        this[box.dataset.key] = box.checked;
        this.draw();
      });
    this.$(".switches button").addEventListener("click", () => this.moveTo([0, 0, 0]));
    this.$(".built button").addEventListener("click", () => this.build({}));
    this.$(".built button").before(...BUILT.map(([key, name, max, step, factor]) => {
      const label = node("label", name), input = Object.assign(node("input"), { type: "range", min: 0, max, step, value: 0 }), output = node("output", "0");
      input.dataset.key = key;
      input.addEventListener("input", () => this.build({ ...this.display.built, [key]: input.value * factor }));
      label.append(input, output);
      return label;
    }));
  }

  // Look at panels "as built". A point pupil would see the black lines as coarse hatching.
  build(built) {
    this.display.built = { ...IDEAL, ...built };
    for (const [key, , , , factor] of BUILT) {
      const input = this.$(`.built [data-key=${key}]`);
      input.value = this.display.built[key] / factor;
      input.nextElementSibling.textContent = input.value;
    }
    if (this.display.built.lines) this.$("[data-key=pupil]").checked = this.pupil = true;
    this.draw();
  }

  #nearer(metres) {
    const least = this.stack.x_m.at(-1) + 0.1 - middle(this.eyesAt([0, 0, 0]))[0];
    const out = Math.max(least, Math.min(1.5, this.head[0] + metres)), scale = this.#closer(out) / this.#closer(this.head[0]);
    this.moveTo([out, this.head[1] * scale, this.head[2] * scale]);
  }

  // How far a head at this distance moves to the side, relative to one at the usual distance. A near head sees the panels
  // at up to 60 degrees, and if it also looked from the side, they would be slivers.
  #closer(out) {
    const usual = middle(this.eyesAt([0, 0, 0]))[0];
    return Math.min(1, ((usual + out) / usual) ** 2);
  }

  // Functions that every page makes available to scripts (docs/contracts.md).
  get doors() {
    return {
      setHead: (head) => this.moveTo([...head]),
      align: (on) => {
        this.$("[data-key=aligned]").checked = this.aligned = Boolean(on);
        this.draw();
      },
      build: (built) => this.build(built),
      focus: (mm) => this.focus(mm),
      picture: (eye, width, height, pupil_mm = 0) => {
        this.display.show(this.#draws());
        return this.display.picture({ eye: this.eyes[eye], fov_deg: this.scene.fov_deg, pupil_mm, focus_m: this.#focus_m }, width, height);
      },
    };
  }
}

const panelName = (n, count) => (n === 0 ? "rear panel" : n === count - 1 ? "front panel" : count === 3 ? "middle panel" : `panel ${n}`);
