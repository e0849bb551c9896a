// The panel: draws what the workbench asks for, device pixel for device pixel, and says so once it is painted.
"use strict";
(() => {
  const canvas = document.getElementById("panel");
  const context = canvas.getContext("2d", { alpha: false });
  const video = document.getElementById("awake");
  const card = document.getElementById("card");
  const token = new URLSearchParams(location.search).get("token");
  const query = token ? "?token=" + encodeURIComponent(token) : "";

  // ---- size: the canvas has exactly one element per device pixel -------------------------------------------------

  function resize(width, height) {
    if (width < 1 || height < 1 || (canvas.width === width && canvas.height === height)) return;
    canvas.width = width;
    canvas.height = height;
    repaint();
  }

  function resizeByRatio() {
    // Round, and give the element the size that makes the ratio exact.
    const ratio = window.devicePixelRatio;
    const width = Math.round(window.innerWidth * ratio);
    const height = Math.round(window.innerHeight * ratio);
    canvas.style.width = width / ratio + "px";
    canvas.style.height = height / ratio + "px";
    resize(width, height);
  }

  function watchSize() {
    // The browser knows which device pixels the element covers; CSS pixels times the ratio only come near them where
    // the ratio is odd. Old browsers can't tell, and some that emulate another screen tell CSS pixels.
    const near = (device, css) => Math.abs(device - css * window.devicePixelRatio) <= 1;
    try {
      new ResizeObserver((entries) => {
        const entry = entries[entries.length - 1];
        const device = entry.devicePixelContentBoxSize[0], css = entry.contentBoxSize[0];
        if (near(device.inlineSize, css.inlineSize) && near(device.blockSize, css.blockSize)) resize(device.inlineSize, device.blockSize);
        else resizeByRatio();
      }).observe(canvas, { box: "device-pixel-content-box" });
    } catch (_) {
      window.addEventListener("resize", resizeByRatio);
      resizeByRatio();
    }
  }

  // ---- drawing: whole device pixels only, nothing smoothed -------------------------------------------------------

  // First pixel of a run of n whose middle is as near as the grid allows to `offset` from the panel's middle.
  const firstPixel = (length, offset, n) => Math.floor(length / 2 + offset - n / 2 + 0.5);

  function disc(x, y, n) {
    // A pixel is lit if its middle lies within the circle of diameter n: 1 and 2 are squares, the rest is round.
    const left = firstPixel(canvas.width, x, n);
    const top = firstPixel(canvas.height, y, n);
    for (let row = 0; row < n; row++) {
      const dy = row + 0.5 - n / 2;
      let skip = 0;
      while (skip < n / 2 && (skip + 0.5 - n / 2) ** 2 + dy * dy > (n * n) / 4) skip++;
      if (n > 2 * skip) context.fillRect(left + skip, top + row, n - 2 * skip, 1);
    }
  }

  function crosshair(n) {
    const w = canvas.width, h = canvas.height, short = Math.min(w, h);
    const across = firstPixel(w, 0, n), down = firstPixel(h, 0, n);
    const gap = Math.max(4 * n, Math.round(short / 40));
    // Lines with a gap, so that the dot in the middle stands alone.
    context.fillRect(0, down, across - gap, n);
    context.fillRect(across + n + gap, down, w, n);
    context.fillRect(across, 0, n, down - gap);
    context.fillRect(across, down + n + gap, n, h);
    disc(0, 0, n % 2 ? 2 * n + 1 : 2 * n);
    const pitch = Math.max(10, Math.round(short / 20));
    for (let i = 1; i * pitch < Math.max(w, h) / 2; i++) {
      const reach = (i % 5 ? 4 : 10) * Math.max(2, n);
      for (const side of [-i, i]) {
        context.fillRect(across + side * pitch, down - reach, n, 2 * reach + n);
        context.fillRect(across - reach, down + side * pitch, 2 * reach + n, n);
      }
    }
    // Corners show in the preview how much of the panel the camera sees, and whether it is square to it.
    const arm = Math.round(short / 8), thick = Math.max(3 * n, Math.round(short / 150)), inset = Math.round(short / 40);
    for (const right of [false, true]) for (const bottom of [false, true]) {
      context.fillRect(right ? w - inset - arm : inset, bottom ? h - inset - thick : inset, arm, thick);
      context.fillRect(right ? w - inset - thick : inset, bottom ? h - inset - arm : inset, thick, arm);
    }
  }

  async function picture(sequence, pattern) {
    const address = "panel/picture" + (query ? query + "&" : "?") + "sequence=" + sequence +
      "&width=" + canvas.width + "&height=" + canvas.height;
    const image = new Image();
    await new Promise((done, failed) => {
      image.onload = done;
      image.onerror = () => failed(new Error("the picture didn't load"));
      image.src = address;
    });
    return () => {
      const shrink = Math.min(1, canvas.width / image.naturalWidth, canvas.height / image.naturalHeight);
      const width = Math.max(1, Math.round(image.naturalWidth * shrink));
      const height = Math.max(1, Math.round(image.naturalHeight * shrink));
      context.imageSmoothingEnabled = shrink < 1;
      context.imageSmoothingQuality = "high";
      context.drawImage(image, firstPixel(canvas.width, pattern.x_px, width),
        firstPixel(canvas.height, pattern.y_px, height), width, height);
    };
  }

  async function draw(shown, mine) {
    const pattern = shown.pattern;
    const drawPicture = pattern.kind === "picture" ? await picture(shown.sequence, pattern) : null;
    if (mine !== generation) return false;
    context.fillStyle = "#000000";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = pattern.colour;
    switch (pattern.kind) {
      case "black": break;
      case "white": context.fillRect(0, 0, canvas.width, canvas.height); break;
      case "dot": disc(pattern.x_px, pattern.y_px, pattern.size_px); break;
      case "grid": for (const [x, y] of pattern.points_px) disc(x, y, pattern.size_px); break;
      case "crosshair": crosshair(pattern.size_px); break;
      case "picture": drawPicture(); break;
      default: throw new Error("unknown pattern " + pattern.kind + ", reload the page");
    }
    return true;
  }

  // ---- painting and acknowledging --------------------------------------------------------------------------------

  let latest = null; // what is to be shown: {sequence, pattern, socket}
  let generation = 0; // of paintings; only the newest may be acknowledged

  async function paint() {
    const shown = latest;
    const mine = ++generation;
    try {
      if (!await draw(shown, mine)) return;
    } catch (error) {
      send(shown.socket, { type: "failed", sequence: shown.sequence, reason: String(error.message).slice(0, 300), state: state() });
      return;
    }
    refresh();
    // The first frame that starts after drawing carries it; when the second starts, the first is out. A hidden page
    // gets no frames, so it never acknowledges.
    requestAnimationFrame(() => requestAnimationFrame(() => {
      if (mine !== generation) return;
      send(shown.socket, { type: "painted", sequence: shown.sequence, state: state() });
    }));
  }

  function repaint() {
    report();
    if (latest) paint();
  }

  function isFullscreen() {
    const whole = document.fullscreenElement || document.webkitFullscreenElement;
    return Boolean(whole) || matchMedia("(display-mode: fullscreen)").matches || navigator.standalone === true;
  }

  function state() {
    return {
      width_px: canvas.width,
      height_px: canvas.height,
      device_pixel_ratio: window.devicePixelRatio,
      fullscreen: isFullscreen(),
      visible: document.visibilityState === "visible",
      zoom: window.visualViewport ? window.visualViewport.scale : 1,
      wake_lock: wakeLock,
    };
  }

  function send(to, message) {
    if (to && to === socket && to.readyState === WebSocket.OPEN) to.send(JSON.stringify(message));
  }

  function report() {
    refresh();
    send(socket, { type: "state", state: state() });
  }

  // ---- connection: comes back by itself --------------------------------------------------------------------------

  const FIRST_WAIT_MS = 250, LONGEST_WAIT_MS = 4000;
  let socket = null;
  let connection = "connecting"; // connecting | open | lost | refused | displaced
  let lostAt = 0;
  let wait = FIRST_WAIT_MS;
  let requireFullscreen = true;
  let silence = 0;
  let retry = 0;

  function connect() {
    clearTimeout(retry);
    const address = new URL("panel/socket" + query, location.href);
    address.protocol = location.protocol.replace("http", "ws");
    const mine = new WebSocket(address.href);
    socket = mine;
    mine.onmessage = (event) => {
      const message = JSON.parse(event.data);
      connection = "open";
      wait = FIRST_WAIT_MS;
      listenFor(mine, 4000 * (message.every_s || 1));
      if (message.type === "hello") {
        requireFullscreen = message.require_fullscreen;
        report();
      } else if (message.type === "show") {
        latest = { sequence: message.sequence, pattern: message.pattern, socket: mine };
        paint();
      } else if (message.type === "beat") {
        report();
      }
    };
    mine.onclose = (event) => lost(mine, event.code);
    listenFor(mine, 5000);
  }

  function listenFor(mine, ms) {
    // A connection that just falls silent (network gone) has no close event for minutes.
    clearTimeout(silence);
    silence = setTimeout(() => { mine.onclose = null; mine.close(); lost(mine, 1006); }, ms);
  }

  async function lost(mine, code) {
    if (mine !== socket) return;
    socket = null;
    clearTimeout(silence);
    if (code === 4001) {
      connection = "displaced";
      latest = null;
      refresh();
      return;
    }
    if (connection === "open" || connection === "displaced") lostAt = Date.now();
    if (connection !== "refused") connection = "lost";
    refresh();
    retry = setTimeout(connect, wait * (0.8 + 0.4 * Math.random()));
    wait = Math.min(2 * wait, LONGEST_WAIT_MS);
    // A refused WebSocket looks like a dead server; ask in a way that tells them apart.
    try {
      const answer = await fetch("panel/alive" + query, { cache: "no-store" });
      if (connection !== "open") connection = answer.status === 403 ? "refused" : "lost";
    } catch (_) {
      if (connection !== "open") connection = "lost";
    }
    refresh();
  }

  // ---- staying awake ---------------------------------------------------------------------------------------------

  let wakeLock = "none"; // lock | video | none
  let sentinel = null;

  async function stayAwake() {
    if (document.visibilityState !== "visible") return;
    if ("wakeLock" in navigator) {
      try {
        if (!sentinel || sentinel.released) {
          sentinel = await navigator.wakeLock.request("screen");
          sentinel.addEventListener("release", () => { wakeLock = "none"; report(); });
        }
        wakeLock = "lock";
        report();
        return;
      } catch (_) { /* refused: low battery, no gesture yet; the video may still do */ }
    }
    // Plain http over the network has no wake lock: browsers give it to secure pages only. A playing video keeps
    // most screens on.
    try {
      if (!video.srcObject) {
        const source = document.createElement("canvas");
        source.width = source.height = 16;
        const pen = source.getContext("2d");
        const tick = () => { pen.fillStyle = "#00000" + (Date.now() % 2); pen.fillRect(0, 0, 16, 16); };
        tick();
        video.srcObject = source.captureStream(2);
        setInterval(tick, 500);
      }
      await video.play();
      wakeLock = "video";
    } catch (_) {
      wakeLock = "none";
    }
    report();
  }

  // ---- what the operator sees before and between patterns --------------------------------------------------------

  function refresh() {
    const full = isFullscreen();
    // A short loss mustn't put light on the panel in the middle of an exposure.
    const lostLong = connection !== "open" && Date.now() - lostAt > 5000;
    const fit = full || !requireFullscreen;
    document.body.classList.toggle("showing", fit && latest !== null && !lostLong && connection !== "displaced");
    const texts = {
      connecting: ["Connecting", "Looking for the workbench at " + location.host + "."],
      lost: ["No connection", "The workbench at " + location.host + " doesn't answer. This page comes back by itself as soon as it does."],
      refused: ["Wrong address", "The workbench was started anew: scan the code in its terminal again."],
      displaced: ["Another page has taken over", "Only one page shows the patterns. Tap here to take them back."],
      open: fit ? ["Ready", "Waiting for the first pattern."] : fullscreenText(),
    };
    const [headline, advice] = texts[connection];
    document.getElementById("headline").textContent = headline;
    document.getElementById("advice").textContent = advice;
    card.classList.toggle("trouble", connection !== "open" && connection !== "connecting");
    const awake = { lock: "screen stays on", video: "screen should stay on (video)", none: "screen may fall asleep: set its timeout to never" }[wakeLock];
    document.getElementById("facts").textContent =
      canvas.width + " × " + canvas.height + " pixels · ratio " + Number(window.devicePixelRatio.toFixed(4)) + " · " + awake;
  }

  function fullscreenText() {
    const can = document.documentElement.requestFullscreen || document.documentElement.webkitRequestFullscreen;
    return can ? ["Tap for full screen", "Then leave the tablet alone; the workbench does the rest."]
      : ["Add to home screen", "This browser shows pages full screen only when opened from the home screen."];
  }

  async function tapped() {
    const root = document.documentElement;
    try {
      if (!isFullscreen()) await (root.requestFullscreen ? root.requestFullscreen({ navigationUI: "hide" }) : root.webkitRequestFullscreen());
    } catch (_) { /* no full screen here; the report says so */ }
    stayAwake();
    if (connection === "displaced" || (!socket && connection !== "open")) {
      connection = "connecting";
      wait = FIRST_WAIT_MS;
      connect();
    }
    repaint();
  }

  document.addEventListener("click", tapped);
  document.addEventListener("contextmenu", (event) => event.preventDefault());
  document.addEventListener("fullscreenchange", repaint);
  document.addEventListener("webkitfullscreenchange", repaint);
  document.addEventListener("visibilitychange", () => { stayAwake(); repaint(); });
  if (window.visualViewport) window.visualViewport.addEventListener("resize", repaint);
  window.addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
  setInterval(refresh, 1000);
  watchSize();
  stayAwake();
  refresh();
  connect();
})();
