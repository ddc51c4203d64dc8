// After display.js, over `given`: all panels' codes in each case as `value`.
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
window.value = given.map(({ stack, flat, layers, size, relief, relief_px, draws }) => {
  const display = new Display(document.createElement("canvas"), stack), { g } = display, { width_px: w, height_px: h } = stack;
  display.load("flat", bytes(flat));
  display.load("solved", bytes(layers), size);
  display.unfold(relief ? new Uint16Array(bytes(relief).buffer) : null, relief_px);
  display.show(draws);
  const all = new Uint8Array(4 * w * h * stack.x_m.length);
  g.bindFramebuffer(g.FRAMEBUFFER, display.framebuffer);
  stack.x_m.forEach((_, n) => {
    g.framebufferTextureLayer(g.FRAMEBUFFER, g.COLOR_ATTACHMENT0, display.textures.shown, 0, n);
    g.readPixels(0, 0, w, h, g.RGBA, g.UNSIGNED_BYTE, all.subarray(4 * w * h * n));
  });
  g.getExtension("WEBGL_lose_context")?.loseContext(); // browsers limit the number of contexts
  return btoa(Array.from(all, (code) => String.fromCharCode(code)).join(""));
});
