// After display.js, over `given`: all panels' codes in each case as `value`.
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const display = new Display(document.createElement("canvas"), given.stack), { g } = display, { width_px: w, height_px: h } = given.stack;
display.load("flat", bytes(given.flat));
window.value = given.cases.map(({ layers, size, relief, relief_px, eyes, flatness }) => {
  display.load("solved", bytes(layers), size);
  display.unfold(relief ? new Uint16Array(bytes(relief).buffer) : null, relief_px);
  display.show(alignment(given.stack, ...eyes), flatness);
  const all = new Uint8Array(4 * w * h * given.stack.x_m.length);
  g.bindFramebuffer(g.FRAMEBUFFER, display.framebuffer);
  given.stack.x_m.forEach((_, n) => {
    g.framebufferTextureLayer(g.FRAMEBUFFER, g.COLOR_ATTACHMENT0, display.textures.shown, 0, n);
    g.readPixels(0, 0, w, h, g.RGBA, g.UNSIGNED_BYTE, all.subarray(4 * w * h * n));
  });
  return btoa(Array.from(all, (code) => String.fromCharCode(code)).join(""));
});
