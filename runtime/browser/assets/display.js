// Optics of a panel stack, rendering with WebGL 2, and plans of eyes and panels.
// Points are in the `stack` frame, in metres: x out of the screen, y to the viewer's right, z up. Matrices are 3x3 and
// stored in row-major order.

const NEAREST_M = 0.01, MOST_SHIFT = 0.5, MOST_SCALE = 2; // alignment limits, the same as in runtime.optics
const PUPILS = 7; // number of points traced in each pupil
const BUILT_RAYS = 4; // least number of rays across a pixel for panels that are not ideal, whose pictures have no exact form

// Imperfections of panels "as built" (runtime/optics/real): the front panel's shift to the right in pixels, how far full
// white is short of 90 degrees, how far black turns, the grey curve's relative error in gamma, black divided by white, and
// the share of a pixel that is black between its subpixels.
export const IDEAL = { shift_px: 0, short_deg: 0, dark_deg: 0, gamma: 0, black: 0, lines: 0 };

export const mul = (a, b) => [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j]));
export const apply = (m, x, y) => {
  const w = m[6] * x + m[7] * y + m[8];
  return [(m[0] * x + m[1] * y + m[2]) / w, (m[3] * x + m[4] * y + m[5]) / w];
};
export const middle = (eyes) => eyes[0].map((_, k) => eyes.reduce((sum, eye) => sum + eye[k], 0) / eyes.length);
export const moved = (eyes, by) => eyes.map((eye) => eye.map((v, k) => v + by[k]));
export const centre = (stack) => stack.x_m[stack.x_m.length >> 1];
const dot = (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0);

function reference(stack) {
  const half = stack.x_m.length >> 1;
  return stack.x_m.length % 2 ? stack.x_m[half] : (stack.x_m[half - 1] + stack.x_m[half]) / 2;
}

// Return the homography that maps a pixel (u right, v down, 1) of an eye's picture to (y, z, 1) on the plane x = x_m.
// The eye looks at the origin.
export function planeFromPicture(eye, picture, x_m) {
  const norm = Math.hypot(...eye), back = eye.map((v) => v / norm), across = Math.hypot(eye[0], eye[1]) || 1;
  const right = [-eye[1] / across, eye[0] / across, 0];
  const up = [-back[2] * right[1], back[2] * right[0], back[0] * right[1] - back[1] * right[0]];
  const focal = picture.width / 2 / Math.tan((picture.fov_deg * Math.PI) / 360);
  const ray = [0, 1, 2].map((k) => [ // direction times focal length, as coefficients of u, v, 1
    right[k], -up[k], -back[k] * focal - (right[k] * picture.width) / 2 + (up[k] * picture.height) / 2]);
  const far = eye[0] - x_m;
  return [...ray[1].map((v, j) => far * v - eye[1] * ray[0][j]), ...ray[2].map((v, j) => far * v - eye[2] * ray[0][j]),
    ...ray[0].map((v) => -v)];
}

// Return half the width and half the height of a picture just large enough for everything that the eyes see through all
// panels, at focal length 1.
export function reach(stack, eyes) {
  const { width_m, height_m, x_m } = stack;
  const found = eyes.map((eye) => {
    const norm = Math.hypot(...eye), back = eye.map((v) => v / norm), across = Math.hypot(eye[0], eye[1]) || 1;
    const right = [-eye[1] / across, eye[0] / across, 0];
    const up = [-back[2] * right[1], back[2] * right[0], back[0] * right[1] - back[1] * right[0]];
    const panels = x_m.map((x) => [-1, 1].flatMap((a) => [-1, 1].map((b) => {
      const ray = [x, (a * width_m) / 2, (b * height_m) / 2].map((v, k) => v - eye[k]), depth = Math.max(1e-6, -dot(ray, back));
      return [dot(ray, right) / depth, dot(ray, up) / depth];
    })));
    return [0, 1].map((k) => Math.max(...[-1, 1].map((side) => // the picture is limited by the narrowest panel
      Math.min(...panels.map((corners) => Math.max(...corners.map((corner) => side * corner[k])))))));
  });
  return [0, 1].map((k) => Math.max(1e-3, ...found.map((one) => one[k])));
}

// Return the field of view in degrees of a picture in which the panels fill the canvas at the usual distance, are larger
// when nearer, and smaller when farther.
export function fieldOfView(stack, eyes, usual_m, width, height) {
  const [across, up] = reach(stack, eyes), focal = 0.48 * Math.min(width / across, height / up) * Math.sqrt(usual_m / Math.hypot(...middle(eyes)));
  return (Math.atan(width / 2 / focal) * 360) / Math.PI;
}

// Return the homography that maps a point (y, z, 1) on the ideal panel to the point on the tilted panel's layer that an
// eye sees in the same direction, or null if the panel is not tilted. Twin of layer_from_seen in runtime/optics/tilt.py.
function layerFromSeen(stack, n, eye) {
  const depth = stack.tilt?.depth[n];
  if (!depth?.some((v) => v)) return null;
  const [offset, right, up] = depth, x = stack.x_m[n], o = stack.tilt.seen_from_m, normal = [1, -right, -up];
  const ideal = [[0, 1, 0], [0, 0, 1], [x, 0, 0]]; // coefficients of y, z, 1
  const far = x + offset - dot(normal, eye);
  const columns = ideal.map((column, k) => {
    const weight = dot(normal, column) - (k === 2 ? dot(normal, eye) : 0);
    const point = eye.map((e, i) => e * weight + (column[i] - (k === 2 ? e : 0)) * far);
    const ahead = point[0] - o[0] * weight;
    return [1, 2].map((i) => o[i] * ahead + (point[i] - o[i] * weight) * (x - o[0])).concat(ahead);
  });
  return [0, 1, 2].flatMap((i) => columns.map((column) => column[i]));
}

// Return the affine transform from (y, z, 1) to panel pixels.
function pixels(stack) {
  const u = stack.width_px / stack.width_m, v = stack.height_px / stack.height_m;
  return [u, 0, stack.width_px / 2, 0, -v, stack.height_px / 2, 0, 0, 1];
}

// Return the homography that maps picture pixels to pixels on panel n. Each pixel's ray runs from `eye` through the
// point on the centre panel that the `nominal` eye sees at that pixel. Twin of panels_from_centre in
// runtime/optics/light.py.
export function panelFromPicture(stack, n, eye, picture, nominal = eye) {
  const x = centre(stack), share = (stack.x_m[n] - eye[0]) / (x - eye[0]);
  const carried = [share, 0, eye[1] * (1 - share), 0, share, eye[2] * (1 - share), 0, 0, 1];
  const seen = layerFromSeen(stack, n, eye);
  const ideal = mul(carried, planeFromPicture(nominal, picture, x));
  return mul(pixels(stack), seen ? mul(seen, ideal) : ideal);
}

// Return the movement that several people share. Twin of common_movement_m in runtime/optics/alignment.py.
const common = (before, after) => [0, 1, 2].map((k) => {
  const steps = after.flatMap((eye, n) => (n % 2 ? [(eye[k] + after[n - 1][k] - before[n][k] - before[n - 1][k]) / 2] : []));
  return Math.max(0, Math.min(...steps)) + Math.min(0, Math.max(...steps));
});

// Return the alignment of solved layers to other eyes of the same people. Twin of align in runtime/optics/alignment.py.
// maps: for each panel, [scale u, scale v, shift u, shift v] from shown pixels to pixels of the solution.
// parallax: how content that is not on the middle panel moves.
// limited: why the alignment reaches its limit before the eyes, or empty if it does not.
export function alignment(stack, solved, eyes) {
  if (eyes.length > 2) eyes = moved(solved, common(solved, eyes));
  const old = middle(solved), now = middle(eyes), step = now.map((v, k) => v - old[k]), r = reference(stack);
  let share = 1, limited = "";
  const limit = (most, least, why) => {
    const reach = least < 0 ? 0 : most <= least ? 1 : least / most;
    if (reach < share) [share, limited] = [reach, why];
    return least >= 0;
  };
  const front = stack.x_m.at(-1);
  const open = solved.every((eye, k) => limit(eye[0] - eyes[k][0], eye[0] - front - NEAREST_M, "too near"));
  for (const x of open ? stack.x_m.filter((x) => x !== r) : []) {
    const far = old[0] - x, weight = (x - r) / (old[0] - r);
    for (const [axis, size] of [[1, stack.width_m], [2, stack.height_m]]) {
      const shift = Math.abs(weight * (old[axis] * step[0] - step[axis] * far));
      limit(shift - MOST_SHIFT * size * step[0], MOST_SHIFT * size * far, "too far");
    }
    limit(step[0] * (1 - MOST_SCALE - weight), (MOST_SCALE - 1) * far, "too far");
    limit(step[0] * (weight + 1 / MOST_SCALE - 1), (1 - 1 / MOST_SCALE) * far, "too far");
  }
  const went = step.map((v) => v * share);
  const maps = stack.x_m.map((x) => {
    const [sx, sy, sz] = went, far = old[0] - x, height = old[0] - r, present = far + sx;
    const larger = (sx * (r - x)) / (present * height);
    const shift = [[1, sy], [2, sz]].map(([k, s]) => (((x - r) / height) * (old[k] * sx - s * far)) / present);
    return mapped(stack, larger, shift);
  });
  return { maps, limited, parallax: parallax(stack, old, old.map((v, k) => v + went[k])) };
}

// Return the map, in pixels, that scales by 1 + larger about the panels' centre and then shifts right and up (in
// metres).
const mapped = (stack, larger, [right, up]) => [1 + larger, 1 + larger,
  ((-stack.width_m / 2) * larger + right) * (stack.width_px / stack.width_m), -((stack.height_m / 2) * larger + up) * (stack.height_px / stack.height_m)];

// Return how content moves when the eyes' midpoint moves from `old` to `now`. The result is null if the midpoint does
// not move, or if there is no middle panel because the number of panels is even. Twin of parallax in
// runtime/optics/relief.py.
function parallax(stack, old, now) {
  if (stack.x_m.length % 2 === 0 || old.every((v, k) => v === now[k])) return null;
  const r = reference(stack), k = (old[0] - r) / (now[0] - r), growth = 1 - k;
  const [, , right, down] = mapped(stack, growth, [1, 2].map((n) => k * now[n] - old[n]));
  const middles = stack.x_m.map((x) => {
    const larger = (x - r) / (now[0] - x);
    return mapped(stack, larger, [1, 2].map((n) => -now[n] * larger));
  });
  return { drift: [right, down, growth], middles, weights: stack.x_m.map((x) => (old[0] - x) / (old[0] - r)) };
}

export const unaligned = (stack) => ({ maps: stack.x_m.map(() => [1, 1, 0, 0]), limited: "", parallax: null });

// Return what the panels show, for `Display.show`. Twin of panel_draws in runtime/optics/presentation.py, which defines
// the fields; maps and pushes are [scale u, scale v, shift u, shift v] for each panel. Positions in the relief are
// fractions of its size.
export function panelDraws(stack, { maps, parallax }, solved_px, flatness = 0) {
  const size_px = [stack.width_px, stack.height_px], coarser = solved_px.map((px, k) => px / size_px[k]);
  const { drift: [right, down, growth], middles, weights } = parallax ?? { drift: [0, 0, 0], middles: maps, weights: maps };
  const by = ([su, sv, tu, tv], [u, v]) => [su * u, sv * v, tu * u, tv * v];
  return {
    size_px, solved_px, flatness, rest: stack.rest_code, extended_px: +coarser.some((by) => by !== 1),
    solved_from_shown: maps.map((map) => by(map, coarser)),
    relief_from_shown: middles.map((map) => by(map, size_px.map((px) => 1 / px))),
    push: middles.map(([su, sv, tu, tv], n) => by([growth * su, growth * sv, right + growth * tu, down + growth * tv], coarser.map((by) => by * (parallax ? weights[n] : 0)))),
  };
}

const VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// Position of a shown pixel in the solution, in its pixels: (P1) in runtime/optics/presentation.py. If the relief is
// unknown, it is 0 everywhere.
const SOLVED_AT = `precision highp float; precision highp sampler2D; precision highp sampler2DArray;
const int PANELS = @PANELS@;
uniform sampler2D relief; uniform vec4 solved_from_shown[PANELS], relief_from_shown[PANELS], push[PANELS]; uniform float rest;
uniform vec2 size_px, solved_px;
vec2 mapped(vec4 by, vec2 px) { return px * by.xy + by.zw; }
vec2 solved_at(int n, vec2 px) {
  return mapped(solved_from_shown[n], px) + texture(relief, mapped(relief_from_shown[n], px)).r * mapped(push[n], px);
}`;

// A layer as shown by its panel: aligned, mixed with the flat picture, and rounded to 8 bits by the framebuffer.
const SHOW = `#version 300 es
${SOLVED_AT}
uniform sampler2DArray layers, flat_picture; uniform int panel; uniform float extended_px, flatness;
out vec4 colour;
vec3 texel(ivec2 at) { // a coarse solution is extended by a pixel, so that its edge does not fade
  ivec2 end = ivec2(solved_px);
  int by = int(extended_px);
  bool inside = all(greaterThanEqual(at, ivec2(-by))) && all(lessThan(at, end + by));
  return inside ? texelFetch(layers, ivec3(clamp(at, ivec2(0), end - 1), panel), 0).rgb : vec3(rest / 255.0);
}
void main() {
  vec2 place = clamp(solved_at(panel, gl_FragCoord.xy) - 0.5, vec2(-3.0), solved_px + 2.0), low = floor(place), w = place - low;
  ivec2 at = ivec2(low);
  vec3 code = flatness >= 1.0 ? vec3(0.0) : mix(mix(texel(at), texel(at + ivec2(1, 0)), w.x),
    mix(texel(at + ivec2(0, 1)), texel(at + ivec2(1, 1)), w.x), w.y);
  if (flatness > 0.0) code = mix(code, texelFetch(flat_picture, ivec3(gl_FragCoord.xy, panel), 0).rgb, flatness);
  colour = vec4(code, 1.0);
}`;

// A draft of an eye's picture, with one ray per pixel through the interpolated solution. A draft takes a tenth of the time
// needed to draw and trace the panels.
const QUICK = `#version 300 es
${SOLVED_AT}
uniform sampler2DArray layers; uniform mat3 into[PANELS]; uniform vec2 origin; uniform vec3 room;
out vec4 colour;
void main() {
  vec3 p = vec3(gl_FragCoord.x - origin.x, origin.y - gl_FragCoord.y, 1.0), h, sum = vec3(0.0);
  vec2 px, at;
  bool seen = true;
#define THROUGH(n) h = into[n] * p; px = h.xy / h.z; at = solved_at(n, px) / solved_px; \\
  seen = seen && h.z > 0.0 && all(greaterThanEqual(px, vec2(0.0))) && all(lessThan(px, size_px)); \\
  sum += clamp(at, 0.0, 1.0) == at ? texture(layers, vec3(at, n)).rgb : vec3(rest / 255.0);
  @EACH@
  vec3 s = sin(sum * 1.5707963267948966);
  colour = vec4(seen ? s * s : room, 1.0);
}`;

// The picture seen by an eye: sin² of the sum of the phases along each ray, averaged over each pixel by the function
// `light`. Panel pixels are uniform squares.
const SEE = (light) => `#version 300 es
precision highp float; precision highp sampler2DArray;
const int PANELS = @PANELS@;
uniform sampler2DArray layers; uniform sampler2D target;
uniform mat3 into[PANELS]; uniform vec2 per_metre[PANELS]; uniform vec2 pupil[${PUPILS}]; uniform int pupils, rays, gain;
uniform vec2 size, origin, stride, picture; uniform vec3 room;
uniform float shift_px, dark, turn, gamma, black, side; // "as built"; side: open share of a subpixel's width and of its height
out vec4 colour;
vec2 off;
vec2 place(int n, vec2 p) { vec3 h = into[n] * vec3(p, 1.0); return h.z > 0.0 ? h.xy / h.z + off * per_metre[n] : vec2(-1.0); }
vec3 malus(vec3 phase) {
  vec3 s = sin(phase * 1.5707963267948966);
  return s * s;
}
${light}
void main() {
  vec2 p = floor(vec2(gl_FragCoord.x - origin.x, origin.y - gl_FragCoord.y)) * stride;
  vec4 sum = vec4(0.0);
  for (int k = 0; k < pupils; k++) {
    off = pupil[k];
    sum += light(p);
  }
  sum /= float(pupils);
  vec3 seen = sum.rgb + room * (1.0 - sum.a);
  if (gain > 0) {
    float coarser = log2(max(1.0, float(textureSize(target, 0).x) / picture.x));
    vec3 wanted = textureLod(target, (p + 0.5) / picture, coarser).rgb;
    seen = gain == 1 ? wanted : sum.a > 0.999 ? abs(seen - wanted) * float(gain) : room;
  }
  colour = vec4(seen, sum.a);
}`;

// A `light` function that averages a grid of `rays` by `rays` rays.
const GRID = `
vec4 ray(vec2 p) { // alpha 1: the ray crosses every panel
  vec3 sum = vec3(0.0);
  float open = 1.0;
  for (int n = 0; n < PANELS; n++) {
    vec2 q = place(n, p);
    if (n == PANELS - 1) q.x -= shift_px;
    if (any(lessThan(q, vec2(0.0))) || any(greaterThanEqual(q, size))) return vec4(0.0);
    vec3 code = texelFetch(layers, ivec3(q, n), 0).rgb;
    sum += dark + turn * (gamma == 1.0 ? code : pow(code, vec3(gamma)));
    if (side < 1.0) {
      vec2 middle = abs(fract(q * vec2(3.0, 1.0)) - 0.5);
      open *= all(lessThan(middle, vec2(0.5 * side))) ? 1.0 / (side * side) : 0.0;
    }
  }
  return vec4(open * mix(malus(sum), vec3(1.0), black), 1.0);
}
vec4 light(vec2 p) {
  float share = 1.0 / float(rays);
  vec4 sum = vec4(0.0);
  for (int j = 0; j < rays; j++) for (int i = 0; i < rays; i++) sum += ray(p + (vec2(i, j) + 0.5) * share);
  return sum * share * share;
}`;

// An exact `light` function, which divides each pixel at every panel pixel edge.
const BOXES = `
float next(float at, float slope) { // distance along the pixel to the next edge
  float edge = slope > 0.0 ? floor(at + 1e-4) + 1.0 : ceil(at - 1e-4) - 1.0;
  return abs(slope) < 1e-6 ? 2.0 : (edge - at) / slope;
}
vec4 light(vec2 p) {
  vec2 at[PANELS], right[PANELS], down[PANELS];
  for (int n = 0; n < PANELS; n++) {
    at[n] = place(n, p + 0.5);
    right[n] = place(n, p + vec2(1.0, 0.5)) - place(n, p + vec2(0.0, 0.5));
    down[n] = place(n, p + vec2(0.5, 1.0)) - place(n, p + vec2(0.5, 0.0));
    if (at[n].x < -2.0 || at[n].y < -2.0 || any(greaterThan(at[n], size + 2.0))) return vec4(0.0);
  }
  vec4 sum = vec4(0.0);
  float v = -0.5;
  for (int j = 0; j < 96 && v < 0.5; j++) {
    float v1 = j == 95 ? 0.5 : min(0.5, v + 0.25);
    for (int n = 0; n < PANELS; n++) v1 = min(v1, v + max(1e-4, next(at[n].y + v * down[n].y, down[n].y)));
    float mid = (v + v1) * 0.5, u = -0.5;
    vec4 row = vec4(0.0);
    for (int i = 0; i < 96 && u < 0.5; i++) {
      float u1 = 0.5;
      if (i < 95) for (int n = 0; n < PANELS; n++) u1 = min(u1, u + max(1e-4, next(at[n].x + u * right[n].x + mid * down[n].x, right[n].x)));
      vec3 phase = vec3(0.0);
      float inside = 1.0;
      for (int n = 0; n < PANELS; n++) {
        vec2 q = at[n] + (u + u1) * 0.5 * right[n] + mid * down[n];
        if (any(lessThan(q, vec2(0.0))) || any(greaterThanEqual(q, size))) inside = 0.0;
        else phase += texelFetch(layers, ivec3(q, n), 0).rgb;
      }
      row += (u1 - u) * inside * vec4(malus(phase), 1.0);
      u = u1;
    }
    sum += (v1 - v) * row;
    v = v1;
  }
  return sum;
}`;

// A panel drawn as a parallelogram, given a corner and two edges in clip space (-1 to 1).
const CARD_VERTEX = `#version 300 es
uniform vec2 corner, right, down; out vec2 at;
void main() { at = vec2(gl_VertexID & 1, gl_VertexID >> 1); gl_Position = vec4(corner + right * at.x + down * at.y, 0.0, 1.0); }`;
const CARD = `#version 300 es
precision highp float; precision highp sampler2DArray;
uniform sampler2DArray layers; uniform int panel; uniform float opacity; in vec2 at; out vec4 colour;
void main() {
  vec2 dx = dFdx(at) * 0.25, dy = dFdy(at) * 0.25;
  vec3 sum = vec3(0.0);
  for (int k = 0; k < 4; k++)
    sum += texture(layers, vec3(at + dx * (k % 2 == 0 ? -1.0 : 1.0) + dy * (k < 2 ? -1.0 : 1.0), panel)).rgb;
  colour = vec4(sum * 0.25, 1.0) * opacity;
}`;

// Draws a display on a canvas. Layers are stored in texture arrays, with one slice for each panel.
export class Display {
  constructor(canvas, stack) {
    this.canvas = canvas;
    this.stack = stack;
    const g = canvas.getContext("webgl2", { preserveDrawingBuffer: true, alpha: false, antialias: false });
    if (!g) throw new Error("this browser does not support WebGL 2");
    this.g = g;
    const { width_px: width, height_px: height, x_m } = stack;
    if (Math.max(width, height) > g.getParameter(g.MAX_TEXTURE_SIZE)) throw new Error("the panels are larger than this browser's maximum texture size");
    this.programs = {};
    const each = x_m.map((_, n) => `THROUGH(${n})`).join(" "), sources = { show: SHOW, quick: QUICK, grid: SEE(GRID), boxes: SEE(BOXES) };
    for (const [name, source] of Object.entries(sources)) this.programs[name] = this.#program(VERTEX, source.replace("@PANELS@", x_m.length).replace("@EACH@", each));
    this.programs.card = this.#program(CARD_VERTEX, CARD);
    this.software = /swiftshader|llvmpipe|softpipe|basic render/i.test(g.getParameter(g.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? g.RENDERER));
    this.textures = { flat: this.#layers(width, height), shown: this.#layers(width, height) };
    this.load("solved", []);
    this.unfold(null);
    this.targets = [null, null];
    this.framebuffer = g.createFramebuffer();
    this.built = IDEAL;
    this.drawn = null; // what `shown` was drawn from; null if it must be drawn again
  }

  #layers(width, height) {
    const g = this.g, texture = g.createTexture();
    g.bindTexture(g.TEXTURE_2D_ARRAY, texture);
    g.texStorage3D(g.TEXTURE_2D_ARRAY, 1, g.RGBA8, width, height, this.stack.x_m.length);
    for (const wrap of [g.TEXTURE_WRAP_S, g.TEXTURE_WRAP_T]) g.texParameteri(g.TEXTURE_2D_ARRAY, wrap, g.CLAMP_TO_EDGE);
    for (const filter of [g.TEXTURE_MIN_FILTER, g.TEXTURE_MAG_FILTER]) g.texParameteri(g.TEXTURE_2D_ARRAY, filter, g.LINEAR);
    return texture;
  }

  #program(vertex, fragment) {
    const g = this.g, program = g.createProgram();
    for (const [kind, source] of [[g.VERTEX_SHADER, vertex], [g.FRAGMENT_SHADER, fragment]]) {
      const shader = g.createShader(kind);
      g.shaderSource(shader, source);
      g.compileShader(shader);
      g.attachShader(program, shader);
    }
    g.linkProgram(program);
    if (!g.getProgramParameter(program, g.LINK_STATUS) && !g.isContextLost())
      throw new Error(`WebGL: ${g.getProgramInfoLog(program)} ${g.getAttachedShaders(program).map((s) => g.getShaderInfoLog(s)).join(" ")}`);
    const places = {};
    for (let k = 0; k < g.getProgramParameter(program, g.ACTIVE_UNIFORMS); k += 1) {
      const { name } = g.getActiveUniform(program, k);
      places[name.replace("[0]", "")] = g.getUniformLocation(program, name);
    }
    return { program, places };
  }

  #use(name, layers) {
    const g = this.g, { program, places } = this.programs[name];
    g.useProgram(program);
    g.activeTexture(g.TEXTURE0);
    g.bindTexture(g.TEXTURE_2D_ARRAY, this.textures[layers]);
    return places;
  }

  // Load the `solved` or `flat` layers from concatenated RGBA bytes or from one picture for each panel. Width and
  // height are the panels' unless the solution is coarser.
  load(name, layers, [w, h] = [this.stack.width_px, this.stack.height_px]) {
    const g = this.g, key = name === "solved" ? `${w}x${h}` : name;
    g.activeTexture(g.TEXTURE0);
    this.textures[key] ??= this.#layers(w, h);
    if (name === "solved") Object.assign(this.textures, { solved: this.textures[key] }), (this.solved_px = [w, h]);
    g.bindTexture(g.TEXTURE_2D_ARRAY, this.textures[key]);
    g.pixelStorei(g.UNPACK_COLORSPACE_CONVERSION_WEBGL, g.NONE);
    if (layers instanceof Uint8Array) g.texSubImage3D(g.TEXTURE_2D_ARRAY, 0, 0, 0, 0, w, h, this.stack.x_m.length, g.RGBA, g.UNSIGNED_BYTE, layers);
    else layers.forEach((image, n) => g.texSubImage3D(g.TEXTURE_2D_ARRAY, 0, 0, 0, n, w, h, 1, g.RGBA, g.UNSIGNED_BYTE, image));
    this.drawn = null;
  }

  // Set the solution's relief on the middle panel from 16-bit floats. If it is null, content does not move on this
  // panel.
  unfold(relief, [w, h] = [1, 1]) {
    const g = this.g;
    g.deleteTexture(this.relief);
    this.relief = g.createTexture();
    g.activeTexture(g.TEXTURE2);
    g.bindTexture(g.TEXTURE_2D, this.relief);
    g.pixelStorei(g.UNPACK_ALIGNMENT, 2);
    g.texImage2D(g.TEXTURE_2D, 0, g.R16F, w, h, 0, g.RED, g.HALF_FLOAT, relief ?? new Uint16Array(1));
    g.pixelStorei(g.UNPACK_ALIGNMENT, 4);
    for (const wrap of [g.TEXTURE_WRAP_S, g.TEXTURE_WRAP_T]) g.texParameteri(g.TEXTURE_2D, wrap, g.CLAMP_TO_EDGE);
    for (const filter of [g.TEXTURE_MIN_FILTER, g.TEXTURE_MAG_FILTER]) g.texParameteri(g.TEXTURE_2D, filter, g.LINEAR);
    this.drawn = null;
  }

  // Set a program's uniforms from the result of `panelDraws`.
  #set(places, draws) {
    const g = this.g;
    for (const [name, value] of Object.entries(draws)) {
      const flat = [value].flat(2);
      g[`uniform${Math.min(flat.length, 4)}fv`](places[name] ?? null, flat);
    }
    g.activeTexture(g.TEXTURE2);
    g.bindTexture(g.TEXTURE_2D, this.relief);
    g.uniform1i(places.relief, 2);
  }

  // Set an eye's target picture, or remove it if `image` is null.
  target(side, image) {
    const g = this.g, texture = image && g.createTexture();
    g.deleteTexture(this.targets[side]);
    this.targets[side] = texture;
    if (!image) return;
    g.activeTexture(g.TEXTURE1);
    g.bindTexture(g.TEXTURE_2D, texture);
    g.pixelStorei(g.UNPACK_COLORSPACE_CONVERSION_WEBGL, g.NONE);
    g.texImage2D(g.TEXTURE_2D, 0, g.RGBA8, g.RGBA, g.UNSIGNED_BYTE, image);
    g.generateMipmap(g.TEXTURE_2D);
    g.texParameteri(g.TEXTURE_2D, g.TEXTURE_MIN_FILTER, g.LINEAR_MIPMAP_LINEAR);
  }

  // Draw the panels from the result of `panelDraws`.
  show(draws) {
    const g = this.g, key = JSON.stringify(draws);
    if (key === this.drawn) return;
    const [w, h] = draws.size_px, places = this.#use("show", "solved");
    this.#set(places, draws);
    g.activeTexture(g.TEXTURE1);
    g.bindTexture(g.TEXTURE_2D_ARRAY, this.textures.flat);
    g.uniform1i(places.flat_picture, 1);
    g.bindFramebuffer(g.FRAMEBUFFER, this.framebuffer);
    g.viewport(0, 0, w, h);
    draws.push.forEach((_, n) => {
      g.framebufferTextureLayer(g.FRAMEBUFFER, g.COLOR_ATTACHMENT0, this.textures.shown, 0, n);
      g.uniform1i(places.panel, n);
      g.drawArrays(g.TRIANGLES, 0, 3);
    });
    g.bindFramebuffer(g.FRAMEBUFFER, null);
    this.drawn = key;
  }

  // Draw one eye's picture into part of the bound framebuffer.
  // nominal: eye whose picture is treated as if painted on the centre panel.
  // part: [x, y, width, height]; y is measured from the bottom.
  // quick: what to sample the solution directly by (`panelDraws`), or null to trace the panels drawn by `show`.
  // rays: number of rays per pixel in each direction, or 0 for the exact picture.
  // focus_m: x of the plane that a pupil with a width focuses on.
  // gain: 0 draws the picture, 1 draws the target, and larger values draw the difference from the target, multiplied by
  // `gain`.
  see({ eye, nominal = eye, picture, part, quick = null, rays = 0, pupil_mm = 0, focus_m = centre(this.stack), side = 0, gain = 0, stride = [1, 1], room = [0.07, 0.08, 0.1] }) {
    if (this.isBuilt) rays = Math.max(rays, rays && pupil_mm && this.software ? BUILT_RAYS / 2 : BUILT_RAYS);
    const g = this.g, { stack } = this, places = quick ? this.#use("quick", "solved") : this.#use(rays ? "grid" : "boxes", "shown");
    g.viewport(...part);
    const columns = [], apart = [];
    for (let n = 0; n < stack.x_m.length; n += 1) {
      const m = panelFromPicture(stack, n, eye, picture, nominal), share = 1 - (stack.x_m[n] - eye[0]) / (focus_m - eye[0]);
      const scale = 1 / (m[6] * picture.width / 2 + m[7] * picture.height / 2 + m[8] || 1); // positive in front of the eye
      for (let k = 0; k < 3; k += 1) columns.push(...[m[k], m[3 + k], m[6 + k]].map((v) => v * scale));
      apart.push((share * stack.width_px) / stack.width_m, (-share * stack.height_px) / stack.height_m);
    }
    g.uniformMatrix3fv(places.into, false, columns);
    g.uniform2f(places.origin, part[0], part[1] + part[3]);
    g.uniform3f(places.room, ...room);
    if (quick) this.#set(places, quick);
    else {
      g.uniform2fv(places.per_metre, apart);
      const points = [0, 0], radius = pupil_mm / 2000;
      for (let k = 0; k < PUPILS - 1; k += 1) points.push(...[Math.cos, Math.sin].map((f) => 0.764 * radius * f((k * Math.PI) / 3)));
      if (places.pupil) g.uniform2fv(places.pupil, points);
      g.uniform1i(places.pupils, pupil_mm > 0 ? PUPILS : 1);
      g.uniform1i(places.rays, rays);
      g.uniform1i(places.gain, this.targets[side] ? gain : 0);
      g.uniform2f(places.size, stack.width_px, stack.height_px);
      g.uniform2f(places.stride, ...stride);
      const { shift_px, short_deg, dark_deg, gamma, black, lines } = this.built;
      const values = { shift_px, dark: dark_deg / 90, turn: 1 - (short_deg + dark_deg) / 90, gamma: 1 + gamma, black, side: Math.sqrt(1 - lines) };
      for (const [name, value] of Object.entries(values)) g.uniform1f(places[name] ?? null, value);
      g.uniform2f(places.picture, picture.width, picture.height);
      g.activeTexture(g.TEXTURE1);
      g.bindTexture(g.TEXTURE_2D, this.targets[side]);
      g.uniform1i(places.target, 1);
    }
    g.drawArrays(g.TRIANGLES, 0, 3);
  }

  // True if the panels are not ideal.
  get isBuilt() {
    return Object.values(this.built).some((v) => v !== 0);
  }

  // Return the picture drawn by `see` as RGBA bytes, top row first. Alpha is 255 where every ray crosses every panel.
  // The picture is drawn in strips of 64 rows, because browsers abort long draw calls.
  seen({ columns, rows, ...how }) {
    const g = this.g, texture = g.createTexture(), bytes = new Uint8Array(columns * rows * 4);
    g.activeTexture(g.TEXTURE1);
    g.bindTexture(g.TEXTURE_2D, texture);
    g.texStorage2D(g.TEXTURE_2D, 1, g.RGBA8, columns, rows);
    g.bindTexture(g.TEXTURE_2D, null);
    g.bindFramebuffer(g.FRAMEBUFFER, this.framebuffer);
    g.framebufferTexture2D(g.FRAMEBUFFER, g.COLOR_ATTACHMENT0, g.TEXTURE_2D, texture, 0);
    g.enable(g.SCISSOR_TEST);
    for (let y = 0; y < rows; y += 64) {
      g.scissor(0, y, columns, 64);
      this.see({ ...how, part: [0, 0, columns, rows] });
      g.flush();
    }
    g.disable(g.SCISSOR_TEST);
    const below = new Uint8Array(columns * rows * 4);
    g.readPixels(0, 0, columns, rows, g.RGBA, g.UNSIGNED_BYTE, below);
    g.bindFramebuffer(g.FRAMEBUFFER, null);
    g.deleteTexture(texture);
    for (let y = 0; y < rows; y += 1) bytes.set(below.subarray((rows - 1 - y) * columns * 4, (rows - y) * columns * 4), y * columns * 4);
    return bytes;
  }

  // Return an eye's exact picture as a PNG data URL.
  picture(how, width, height) {
    const bytes = this.seen({ ...how, columns: width, rows: height, picture: { width, height, fov_deg: how.fov_deg } });
    for (let k = 3; k < bytes.length; k += 4) bytes[k] = 255;
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(bytes.buffer), width, height), 0, 0);
    return canvas.toDataURL("image/png");
  }

  // Return the three 8-bit values that panel n shows at a pixel.
  codes(n, u, v) {
    const g = this.g, found = new Uint8Array(4);
    g.bindFramebuffer(g.FRAMEBUFFER, this.framebuffer);
    g.framebufferTextureLayer(g.FRAMEBUFFER, g.COLOR_ATTACHMENT0, this.textures.shown, 0, n);
    g.readPixels(Math.floor(u), Math.floor(v), 1, 1, g.RGBA, g.UNSIGNED_BYTE, found);
    g.bindFramebuffer(g.FRAMEBUFFER, null);
    return [...found.slice(0, 3)];
  }

  // Draw panel n as a parallelogram, given a corner and the edges to the right and down from it, in canvas pixels.
  card(n, corner, right, down, opacity = 1) {
    const g = this.g, places = this.#use("card", "shown"), { width, height } = this.canvas;
    g.viewport(0, 0, width, height);
    g.enable(g.BLEND);
    g.blendFunc(g.ONE, g.ONE_MINUS_SRC_ALPHA);
    g.uniform2f(places.corner, (2 * corner[0]) / width - 1, 1 - (2 * corner[1]) / height);
    for (const [name, [x, y]] of [["right", right], ["down", down]]) g.uniform2f(places[name], (2 * x) / width, (-2 * y) / height);
    g.uniform1i(places.panel, n);
    g.uniform1f(places.opacity, opacity);
    g.drawArrays(g.TRIANGLE_STRIP, 0, 4);
    g.disable(g.BLEND);
  }
}

// Draw a plan of people's eyes and panels in an SVG element, seen from above (axis 1) or from the side (axis 2). The x axis,
// which points towards the viewer, points right in the plan.
export function drawPlan(svg, { stack, eyes, axis, range = null, sigma_m = 0, solved = null, far_m = 1 }) {
  const size_m = axis === 1 ? stack.width_m : stack.height_m;
  const far = Math.max(far_m, ...(eyes ?? []).map(([x]) => 1.15 * x));
  const wide = Math.max(size_m / 2, ...[...(eyes ?? []), ...(solved ?? [])].map((eye) => Math.abs(eye[axis])));
  const scale = Math.min(300 / (far + 0.15), 78 / wide);
  const at = (x, across) => [10 + (x + 0.15) * scale, 85 - across * scale], shapes = [];
  const add = (name, attributes) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    shapes.push(made);
  };
  const line = (from, to, kind) => {
    const [[x1, y1], [x2, y2]] = [at(...from), at(...to)];
    add("line", { x1, y1, x2, y2, class: kind });
  };
  if (range) add("polygon", { points: range.map(([x, across]) => at(x, across).map((v) => v.toFixed(1)).join(",")).join(" "), class: "range" });
  for (const x of stack.x_m) line([x, -size_m / 2], [x, size_m / 2], "panel");
  for (const eye of solved ?? []) {
    const [cx, cy] = at(eye[0], eye[axis]);
    add("circle", { cx, cy, r: 4.5, class: "solved" });
  }
  eyes?.forEach((eye, index) => {
    const side = index % 2 ? "right" : "left", place = [eye[0], eye[axis]], [cx, cy] = at(...place);
    for (const edge of [-size_m / 2, size_m / 2]) line(place, [stack.x_m[0], edge], `ray ${side}`);
    add("circle", { cx, cy, r: Math.max(sigma_m * scale, 0.1), class: `sure ${side}` });
    add("circle", { cx, cy, r: 3.5, class: side });
  });
  svg.replaceChildren(...shapes);
}
