// ==UserScript==
// @name        WebXR on a phasestack display
// @match       *://*/*
// @run-at      document-start
// @grant       none
// ==/UserScript==

// Answers `navigator.xr` for pages made for headsets or for `inline-stereo`, and sends their pictures to the scene
// `program` (docs/programs.md). Include it before all other scripts of a page, or install it as a user script.
(() => {
  "use strict";
  const NATIVE = navigator.xr, NativeLayer = window.XRWebGLLayer;
  const FLOOR_M = 1.6; // height of the eyes above the floor
  const IPD_M = 0.063; // distance between the eyes, if only one is known
  const HEADSET_M = 2; // distance in the page that is shown at the display, for `immersive-vr`
  const FIRST_S = 10; // time limit for the display's first request
  const LATE_MS = 400; // the display drops later pictures
  const STALE_MS = 500; // frames are drawn at this interval if the display asks for none
  const HOPS = 50; // steps for which a page's asynchronous callback may wait, all in one task, before its picture is read

  // Settings, in order of precedence: the page's address (#phasestack=ws://...&comfort=1), `data-` attributes of this
  // script's element, and earlier entries. They can be changed while a session runs.
  const given = { ...document.currentScript?.dataset }, hash = new URLSearchParams(location.hash.slice(1));
  if (hash.has("phasestack")) {
    Object.assign(given, Object.fromEntries(hash), { address: hash.get("phasestack") });
    history.replaceState(history.state, "", location.pathname + location.search); // the token is a secret
  }
  const stored = (value) => { // sessionStorage is missing in some frames
    try { return value === undefined ? sessionStorage.phasestack : (sessionStorage.phasestack = value); } catch { return undefined; }
  };
  const settings = {
    address: given.address ?? stored() ?? "",
    comfort_deg: Number(given.comfort ?? 1), // largest difference in vergence between far content and the display
    distance_m: Number(given.distance ?? 0), // distance in the page that is shown at the display; 0: 2 m, or 1:1 if inline
    back_m: Number(given.back ?? 0), // how far the viewer stands behind the page's origin
    scale: Number(given.scale ?? 1), // of the pictures, 0.1 to 1
    quality: Number(given.quality ?? 0.95), // of JPEG
    problem: "", // reason for a missing picture
    frames: 0, // drawn so far
  };
  if (settings.address) stored(settings.address);
  window.phasestackXR = settings;

  document.addEventListener("securitypolicyviolation", ({ blockedURI }) => {
    if (settings.address && settings.address.startsWith(blockedURI)) settings.problem = "the page's content security policy forbids a connection to phasestack";
  });

  // The display.

  class Display {
    constructor(onRequest) {
      Object.assign(this, { onRequest, last: null, opened: false, ended: false });
      this.connect();
    }

    connect() {
      this.socket = new WebSocket(settings.address); // may throw SyntaxError
      this.socket.onopen = () => {
        this.opened = true;
        const hello = { name: document.title || location.host, rows: "bottom-up", encoding: "jpeg", scale: settings.scale };
        this.socket.send(JSON.stringify(hello));
      };
      this.socket.onmessage = ({ data }) => {
        settings.problem = "";
        this.last = JSON.parse(data);
        this.onRequest(this.last);
      };
      this.socket.onclose = ({ reason }) => {
        settings.problem = reason || (this.opened ? "the connection to phasestack was closed" :
          `phasestack cannot be reached at ${settings.address.replace(/=.*/, "=...")}; is it running, is the token right, and may this page access the local network?`);
        console.warn(`phasestack: ${settings.problem}`);
        if (this.opened && !this.ended) setTimeout(() => this.ended || this.connect(), 1000);
      };
    }

    async first() {
      for (let k = 0; k < FIRST_S * 50 && !this.last && !settings.problem; k += 1) await new Promise((done) => setTimeout(done, 20));
      if (!this.last) settings.problem ||= "phasestack asks for no pictures; does it show the scene `program`?";
      return this.last;
    }

    send(frame, eye, jpeg) {
      const head = new DataView(new ArrayBuffer(8));
      head.setUint32(0, frame, true);
      head.setUint32(4, eye, true);
      if (this.socket.readyState === WebSocket.OPEN) this.socket.send(new Blob([head, jpeg]));
    }

    close() {
      this.ended = true;
      this.socket.close();
    }
  }

  // Geometry. Matrices are DOMMatrix objects. The page's world is its space `local`: x to the right, y up, z to the
  // viewer, with its origin where the eyes are when the session begins. The display's axes are in docs/programs.md.

  const translated = (x, y, z) => new DOMMatrix([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const less = (a, b, k) => a.map((value, n) => value - k * b[n]);
  const unit = (a) => a.map((value) => value / Math.hypot(...a));
  const middle = (points) => [0, 1, 2].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length);

  /** Where the page's world is: its scale, and a relief that keeps far content within the comfortable depth. */
  function displayFromWorld(viewer_m, ipd_m, isInline) {
    const distance_m = settings.distance_m || (isInline ? viewer_m : HEADSET_M), small = viewer_m / distance_m;
    const placed = new DOMMatrix([0, small, 0, 0, 0, 0, small, 0, small, 0, 0, 0, viewer_m, 0, 0, 1]);
    // The relief keeps the display's plane and all that the resting eye sees, and puts infinity at `rear` (1/m). It makes
    // inverse distances differ by k times as much, and eyes move by k times as much.
    const rear = 1 / viewer_m - settings.comfort_deg * Math.PI / 180 / ipd_m;
    const bend = rear > 0 ? -rear : 0;
    return new DOMMatrix([1 + bend * viewer_m, 0, 0, bend, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]).multiply(placed);
  }

  /** An eye's pose in the page's world and its projection, so that together they are what the display asked for. */
  function cameraOf(eye, fromWorld, near, far) {
    const clip = new DOMMatrix(eye.projection).multiply(new DOMMatrix(eye.view)).multiply(fromWorld);
    const row = (k) => [0, 4, 8].map((column) => clip.toFloat64Array()[column + k]);
    const [across, upward, depth] = [row(0), row(1), row(3)];
    const forward = unit(depth), right = unit(less(across, forward, dot(across, forward)));
    const flat = less(upward, forward, dot(upward, forward)), up = unit(less(flat, right, dot(flat, right)));
    const at = fromWorld.inverse().transformPoint(new DOMPoint(...eye.eye_m)), w = at.w;
    const pose = new DOMMatrix([...right, 0, ...up, 0, ...forward.map((v) => -v), 0, at.x / w, at.y / w, at.z / w, 1]);
    const projection = clip.multiply(pose).toFloat64Array().map((value) => value / Math.hypot(...depth));
    const [a, b] = Number.isFinite(far) ? [-(far + near) / (far - near), -2 * far * near / (far - near)] : [-1, -2 * near];
    [[2, 0], [6, 0], [10, a], [14, b], [3, 0], [7, 0], [11, -1], [15, 0], [12, 0], [13, 0]].forEach(([n, value]) => { projection[n] = value; });
    return { pose, projection: Float32Array.from(projection) };
  }

  class OwnTransform { // for browsers without WebXR
    #matrix;
    constructor(position = {}, orientation = {}) {
      const { x = 0, y = 0, z = 0, w = 1 } = orientation, n = Math.hypot(x, y, z, w);
      this.position = new DOMPointReadOnly(position.x ?? 0, position.y ?? 0, position.z ?? 0, 1);
      this.orientation = new DOMPointReadOnly(x / n, y / n, z / n, w / n);
      const q = this.orientation, [px, py, pz] = [this.position.x, this.position.y, this.position.z];
      this.#matrix = new DOMMatrix([
        1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.z * q.w), 2 * (q.x * q.z - q.y * q.w), 0,
        2 * (q.x * q.y - q.z * q.w), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.x * q.w), 0,
        2 * (q.x * q.z + q.y * q.w), 2 * (q.y * q.z - q.x * q.w), 1 - 2 * (q.x * q.x + q.y * q.y), 0, px, py, pz, 1]);
      this.matrix = this.#matrix.toFloat32Array();
    }

    get inverse() { return rigid(this.#matrix.inverse()); }
  }
  const Transform = window.XRRigidTransform ?? OwnTransform;

  function rigid(m) {
    const q = { // each from the matrix's diagonal, with the sign of what is not on it
      x: Math.sqrt(Math.max(0, 1 + m.m11 - m.m22 - m.m33)) / 2 * Math.sign(m.m23 - m.m32 || 1),
      y: Math.sqrt(Math.max(0, 1 - m.m11 + m.m22 - m.m33)) / 2 * Math.sign(m.m31 - m.m13 || 1),
      z: Math.sqrt(Math.max(0, 1 - m.m11 - m.m22 + m.m33)) / 2 * Math.sign(m.m12 - m.m21 || 1),
      w: Math.sqrt(Math.max(0, 1 + m.m11 + m.m22 + m.m33)) / 2,
    };
    return new Transform({ x: m.m41, y: m.m42, z: m.m43, w: 1 }, q);
  }

  // The interface for pages.

  class Target extends EventTarget {
    tell(type, more = {}) {
      const event = Object.assign(new Event(type), more);
      this[`on${type}`]?.(event);
      this.dispatchEvent(event);
    }
  }

  class ReferenceSpace extends Target {
    constructor(worldFromSpace) { super(); this.worldFromSpace = worldFromSpace; this.onreset = null; }

    getOffsetReferenceSpace(offset) {
      return new ReferenceSpace(() => this.worldFromSpace().multiply(DOMMatrix.fromFloat32Array(Float32Array.from(offset.matrix))));
    }
  }

  class Frame {
    constructor(session, views) { Object.assign(this, { session, asked: views, active: true, predictedDisplayTime: performance.now() }); }

    getViewerPose(space) {
      const spaceFromWorld = space.worldFromSpace().inverse();
      const views = this.asked.map(({ eye, pose, projection }) => ({
        eye, projectionMatrix: projection, transform: rigid(spaceFromWorld.multiply(pose)), recommendedViewportScale: null, isFirstPersonObserver: false,
        requestViewportScale() {},
      }));
      return { ...this.getPose({ worldFromSpace: () => this.session.viewer }, space), views };
    }

    getPose(space, base) {
      return { transform: rigid(base.worldFromSpace().inverse().multiply(space.worldFromSpace())), emulatedPosition: false, linearVelocity: null, angularVelocity: null };
    }
  }

  class Layer {
    #drawn = null;
    constructor(session, gl, { antialias = true, framebufferScaleFactor = 1 } = {}) {
      if (!(session instanceof Session)) return new NativeLayer(...arguments);
      if (!gl.blitFramebuffer) throw new DOMException("phasestack needs a page that draws with WebGL 2", "NotSupportedError");
      Object.assign(this, { session, gl, antialias, ignoreDepthValues: true, fixedFoveation: null, framebuffer: null });
      if (session.isInline) return;
      this.#drawn = [2 * session.size[0], session.size[1]].map((edge) => Math.max(2, Math.round(edge * framebufferScaleFactor / 2) * 2));
      this.framebuffer = this.#made(gl, ...this.#drawn, antialias ? Math.min(4, gl.getParameter(gl.MAX_SAMPLES)) : 0);
    }

    get framebufferWidth() { return this.#drawn?.[0] ?? this.gl.drawingBufferWidth; }
    get framebufferHeight() { return this.#drawn?.[1] ?? this.gl.drawingBufferHeight; }
    static getNativeFramebufferScaleFactor() { return 1; }

    getViewport(view) {
      const width = this.framebufferWidth >> 1;
      return { x: view.eye === "right" ? width : 0, y: 0, width, height: this.framebufferHeight };
    }

    #made(gl, width, height, samples) {
      const before = [gl.getParameter(gl.FRAMEBUFFER_BINDING), gl.getParameter(gl.RENDERBUFFER_BINDING)], made = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, made);
      for (const [format, at] of [[gl.RGBA8, gl.COLOR_ATTACHMENT0], [gl.DEPTH24_STENCIL8, gl.DEPTH_STENCIL_ATTACHMENT]]) {
        const buffer = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
        gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, width, height);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, at, gl.RENDERBUFFER, buffer);
        (made.buffers ??= []).push(buffer);
      }
      gl.bindFramebuffer(gl.FRAMEBUFFER, before[0]);
      gl.bindRenderbuffer(gl.RENDERBUFFER, before[1]);
      return made;
    }

    #deleted(made) {
      made?.buffers.forEach((buffer) => this.gl.deleteRenderbuffer(buffer));
      if (made) this.gl.deleteFramebuffer(made);
    }

    /** Runs `use` with a known state of WebGL, and gives the page its own state back. */
    #with(use) {
      const { gl } = this, get = (name) => gl.getParameter(name);
      const bound = [get(gl.DRAW_FRAMEBUFFER_BINDING), get(gl.READ_FRAMEBUFFER_BINDING), get(gl.PIXEL_PACK_BUFFER_BINDING)];
      const masks = [get(gl.COLOR_WRITEMASK), get(gl.DEPTH_WRITEMASK), get(gl.STENCIL_WRITEMASK)], scissors = gl.isEnabled(gl.SCISSOR_TEST);
      const packed = [gl.PACK_ALIGNMENT, gl.PACK_ROW_LENGTH, gl.PACK_SKIP_PIXELS, gl.PACK_SKIP_ROWS].map((name) => [name, get(name)]);
      gl.disable(gl.SCISSOR_TEST);
      gl.colorMask(true, true, true, true);
      gl.depthMask(true);
      gl.stencilMask(-1);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
      packed.forEach(([name], n) => gl.pixelStorei(name, n ? 0 : 4));
      use(gl);
      packed.forEach(([name, value]) => gl.pixelStorei(name, value));
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, bound[2]);
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, bound[0]);
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, bound[1]);
      gl.colorMask(...masks[0]);
      gl.depthMask(masks[1]);
      gl.stencilMask(masks[2]);
      if (scissors) gl.enable(gl.SCISSOR_TEST);
    }

    /** Clears what the page draws into, as WebXR promises. */
    cleared() {
      if (!this.framebuffer) return;
      this.#with((gl) => {
        gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.framebuffer);
        gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
        gl.clearBufferfi(gl.DEPTH_STENCIL, 0, 1, 0);
      });
    }

    /** Functions that paint the pictures of the eyes in a request, bottom row first, on canvases of the requested size. */
    read({ width, height, eyes }) {
      const pictures = [];
      if (!this.framebuffer) return eyes.map((eye) => (context) => { // now, before the browser shows the page's canvas
        const view = this.getViewport(eye);
        context.setTransform(1, 0, 0, -1, 0, height);
        context.drawImage(this.gl.canvas, view.x, 0, view.width, view.height, 0, 0, width, height);
      });
      this.#with((gl) => {
        const [whole_w, whole_h] = [this.framebufferWidth, this.framebufferHeight];
        if (this.#sized !== `${whole_w} ${whole_h} ${width} ${height}`) {
          [this.whole, this.part].forEach((one) => this.#deleted(one));
          this.whole = this.#made(gl, whole_w, whole_h, 0);
          this.part = this.#made(gl, width, height, 0);
          this.#sized = `${whole_w} ${whole_h} ${width} ${height}`;
        }
        const copy = (from, to, box, other, filter) => {
          gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from);
          gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to);
          gl.blitFramebuffer(...box, ...other, gl.COLOR_BUFFER_BIT, filter);
        };
        const all = [0, 0, whole_w, whole_h];
        copy(this.framebuffer, this.whole, all, all, gl.NEAREST);
        for (const { eye } of eyes) {
          const view = this.getViewport({ eye });
          copy(this.whole, this.part, [view.x, 0, view.x + view.width, view.height], [0, 0, width, height], gl.LINEAR);
          gl.colorMask(false, false, false, true);
          gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 1]); // the picture is opaque
          gl.colorMask(true, true, true, true);
          gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.part);
          const pixels = new Uint8ClampedArray(4 * width * height);
          gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
          pictures.push((context) => context.putImageData(new ImageData(pixels, width, height), 0, 0));
        }
      });
      return pictures;
    }
    #sized = "";
  }

  class Session extends Target {
    #callbacks = new Map();
    #count = 0;
    #pending = {};
    #ended = false;
    #canvas = document.createElement("canvas");
    constructor(isInline, features) {
      super();
      Object.assign(this, { isInline, enabledFeatures: features, inputSources: [], trackedSources: [], environmentBlendMode: "opaque", visibilityState: "visible",
        interactionMode: isInline ? "screen-space" : "world-space", isSystemKeyboardSupported: false, viewer: new DOMMatrix() });
      this.renderState = { baseLayer: null, layers: [], depthNear: 0.1, depthFar: 1000, inlineVerticalFieldOfView: isInline ? Math.PI / 2 : null };
      this.display = new Display((request) => this.#draw(request));
      this.onkey = ({ key }) => key === "Escape" && !isInline && this.end();
      window.addEventListener("keydown", this.onkey);
      this.timer = setInterval(() => performance.now() - this.drawn_ms > STALE_MS && this.display.last && this.#frame(this.display.last), STALE_MS);
      this.drawn_ms = 0;
    }

    /** Waits for the first request, from which the picture's size and the viewer's place come. */
    async begun() {
      const first = await this.display.first();
      if (!first) {
        this.#close();
        throw new DOMException(settings.problem, "NotSupportedError");
      }
      this.size = [first.width, first.height];
      this.viewer_m = middle(first.eyes.map((eye) => eye.eye_m))[0];
      return this;
    }

    updateRenderState(state) {
      if (this.#ended) throw new DOMException("the session has ended", "InvalidStateError");
      if (state.layers?.length) throw new DOMException("layers are not supported", "NotSupportedError");
      this.#pending = { ...this.#pending, ...state };
    }

    async requestReferenceSpace(type) {
      const local = () => translated(0, 0, -settings.back_m);
      const places = { viewer: () => this.viewer, local, unbounded: local, "local-floor": () => translated(0, -FLOOR_M, -settings.back_m) };
      if (!(type in places)) throw new DOMException(`the reference space ${type} is not supported`, "NotSupportedError");
      return new ReferenceSpace(places[type]);
    }

    requestAnimationFrame(callback) {
      this.#callbacks.set(this.#count += 1, callback);
      return this.#count;
    }

    cancelAnimationFrame(handle) { this.#callbacks.delete(handle); }

    async end() {
      if (this.#ended) throw new DOMException("the session has ended", "InvalidStateError");
      this.#close();
      this.tell("end", { session: this });
    }

    #close() {
      this.#ended = true;
      this.display.close();
      clearInterval(this.timer);
      window.removeEventListener("keydown", this.onkey);
    }

    async #draw(request) {
      const asked_ms = performance.now(), layer = await this.#frame(request);
      if (!layer) return;
      this.#send(request, layer.read(request));
      const taken_ms = performance.now() - asked_ms;
      if (taken_ms > LATE_MS) settings.problem = `the page took ${taken_ms.toFixed()} ms to draw, but has ${LATE_MS} ms; a smaller \`scale\` helps`;
    }

    /** Lets the page draw. Returns the layer, or nothing if it has none yet. */
    async #frame(request) {
      if (this.#ended || !this.viewer_m) return null;
      this.renderState = { ...this.renderState, ...this.#pending };
      this.#pending = {};
      const { baseLayer, depthNear, depthFar } = this.renderState;
      if (!baseLayer || !this.#callbacks.size) return null;
      const eyes = request.eyes, ipd_m = eyes.length > 1 ? Math.hypot(...less(eyes[0].eye_m, eyes[1].eye_m, 1)) : IPD_M;
      const fromWorld = displayFromWorld(this.viewer_m, ipd_m, this.isInline);
      const views = ["left", "right"].map((eye) => ({ // the page always draws two
        eye, ...cameraOf(eyes.find((one) => one.eye === eye) ?? eyes[0], fromWorld, depthNear, depthFar),
      }));
      const at = middle(views.map(({ pose }) => [pose.m41, pose.m42, pose.m43]));
      this.viewer = translated(...at);
      baseLayer.cleared();
      const frame = new Frame(this, views), callbacks = [...this.#callbacks.values()];
      this.#callbacks.clear();
      this.drawn_ms = performance.now();
      for (const callback of callbacks) {
        try { callback(this.drawn_ms, frame); } catch (error) { reportError(error); }
      }
      for (let k = 0; k < HOPS; k += 1) await null;
      frame.active = false;
      settings.frames += 1;
      return this.#ended ? null : baseLayer;
    }

    #send({ frame, width, height, eyes }, pictures) {
      const canvas = Object.assign(this.#canvas, { width, height }), context = canvas.getContext("2d", { willReadFrequently: true });
      pictures.forEach((paint, n) => {
        paint(context);
        // At once, because `convertToBlob` waits for an idle moment, for up to 1 s if the page is busy drawing.
        const [, base64] = canvas.toDataURL("image/jpeg", settings.quality).split(",");
        this.display.send(frame, eyes[n].eye === "left" ? 0 : 1, Uint8Array.fromBase64(base64));
      });
    }
  }

  class System extends Target {
    ondevicechange = null;

    async isSessionSupported(mode) { return mode === "inline" || mode === "immersive-vr" || (NATIVE?.isSessionSupported(mode) ?? false); }

    async requestSession(mode, { requiredFeatures = [], optionalFeatures = [] } = {}) {
      const known = ["viewer", "local", "local-floor", "unbounded", "inline-stereo"], isInline = mode === "inline";
      const isOurs = mode === "immersive-vr" || (isInline && [...requiredFeatures, ...optionalFeatures].includes("inline-stereo"));
      if (!isOurs && NATIVE) return NATIVE.requestSession(...arguments);
      const missing = requiredFeatures.filter((feature) => !known.includes(feature));
      if (!isOurs || missing.length) throw new DOMException(`not supported by phasestack: ${missing.join(", ") || mode}`, "NotSupportedError");
      if (!settings.address) {
        settings.address = window.prompt("Address of phasestack's scene `program` (see `phasestack status`):", "ws://127.0.0.1:") ?? "";
        stored(settings.address);
      }
      const features = new Set(["viewer", ...(isInline ? [] : ["local"]), ...requiredFeatures, ...optionalFeatures.filter((one) => known.includes(one))]);
      settings.problem = "";
      return new Session(isInline, [...features]).begun();
    }
  }

  const define = (name, value) => Object.defineProperty(window, name, { value, configurable: true, writable: true });
  Object.defineProperty(navigator, "xr", { value: new System(), configurable: true });
  Object.entries({ XRSystem: System, XRSession: Session, XRFrame: Frame, XRReferenceSpace: ReferenceSpace, XRWebGLLayer: Layer, XRRigidTransform: Transform })
    .forEach(([name, value]) => define(name, value));
  ["XRWebGLBinding", "XRMediaBinding"].forEach((name) => define(name, undefined)); // pages then draw into an XRWebGLLayer
  for (const { prototype } of [window.WebGLRenderingContext, window.WebGL2RenderingContext].filter(Boolean)) prototype.makeXRCompatible = async () => {};
})();
