// The align page: shows what is pushed, says how old it is, and passes presses on.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const token = new URLSearchParams(location.search).get("token");
  const query = token ? "?token=" + encodeURIComponent(token) : "";
  const LONGEST_HISTORY = 240, STALE_MS = 5000, SILENT_MS = 4000;
  const COLOURS = getComputedStyle(document.documentElement);
  const colour = (name) => COLOURS.getPropertyValue("--" + name).trim();

  let socket = null, wait = 250, silence = 0;
  let latest = null, picture = null, history = [], shownAt = 0;
  let actions = [], active = "", news = "";

  // ---- connection ------------------------------------------------------------------------------------------------

  function connect() {
    const address = new URL("align/socket" + query, location.href);
    address.protocol = location.protocol.replace("http", "ws");
    const mine = new WebSocket(address.href);
    mine.binaryType = "blob";
    socket = mine;
    const lost = () => {
      if (mine !== socket) return;
      socket = null;
      clearTimeout(silence);
      setTimeout(connect, wait * (0.8 + 0.4 * Math.random()));
      wait = Math.min(2 * wait, 4000);
      showAge();
    };
    const alive = () => {
      clearTimeout(silence);
      silence = setTimeout(() => { mine.close(); lost(); }, SILENT_MS);
    };
    mine.onmessage = (event) => {
      if (mine !== socket) return;
      wait = 250;
      alive();
      if (typeof event.data === "string") heard(JSON.parse(event.data));
      else showPicture(event.data);
    };
    mine.onclose = lost;
    alive();
  }

  function heard(message) {
    if (message.type === "hello") {
      history = message.history;
      actions = message.actions;
      active = message.active;
      showActions();
    } else if (message.type === "sample") {
      remember(message.number, message.sample);
      latest = message;
      shownAt = performance.now() - 1000 * message.age_s;
      showSample();
    } else if (message.type === "action") {
      active = message.active;
      byId("trouble").textContent = message.trouble;
      showActions();
    } else if (message.type === "beat" && message.active !== active) {
      active = message.active;
      showActions();
    }
    if (message.news !== undefined && message.news !== news) {
      news = message.news;
      byId("trouble").textContent = capital(news);
    }
    showAge();
  }

  function remember(number, sample) {
    // After connecting, the newest sample may be part of the history already.
    if (history.length && history[history.length - 1].number >= number) return;
    history.push({ number, distance_px: sample.distance_px, peak: sample.peak, width_px: sample.width_px, saturated_px: sample.saturated_px });
    if (history.length > LONGEST_HISTORY) history.shift();
  }

  // ---- numbers ---------------------------------------------------------------------------------------------------

  const MARKS = { good: "✓", info: "○", warn: "!", bad: "✕" };
  const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
  const number = (value, digits) => value === null || value === undefined ? "–" : value.toFixed(digits);
  const pixels = (value) => value === null ? "–" : value < 100 ? value.toFixed(1) : value.toFixed(0);

  function level(aspects) {
    const found = latest.findings.find((finding) => aspects.includes(finding.aspect));
    return found ? found.level : "";
  }

  function tile(id, value, detail, state) {
    const element = byId(id);
    element.className = "tile " + state;
    element.querySelector("b").textContent = value;
    element.querySelector(".detail").textContent = detail || "\u00a0";
  }

  function verdict(state, mark, headline, others) {
    byId("verdict").className = state;
    byId("mark").textContent = mark;
    byId("headline").textContent = headline;
    byId("headline").classList.toggle("long", headline.length > 44);
    byId("others").textContent = others;
  }

  function showSample() {
    const { sample, findings, narrowest_px: narrowest, tolerance } = latest;
    const worst = findings[0];
    const others = findings.slice(1).map((finding) => capital(finding.text));
    if (sample.task) others.push("Press Dot to measure");
    verdict(worst.level, MARKS[worst.level], capital(worst.text), others.join("  ·  "));
    const side = (value, low, high) => Math.floor(Math.abs(value) + 0.5) + " " + (value < 0 ? low : high);
    const offset = sample.offset_px;
    const onPanel = sample.offset_mm ? " · panel " + pixels(Math.hypot(...sample.offset_mm)) + " mm" : "";
    tile("offset", pixels(sample.distance_px), offset ? side(offset[0], "left", "right") + ", " + side(offset[1], "up", "down") + onPanel : sample.note, level(["centre", "point"]));
    tile("peak", sample.peak === null ? "–" : number(100 * sample.peak, 0), exposureText(sample), level(["exposure"]));
    tile("width", number(sample.width_px, 1), narrowest === null ? "" : "narrowest " + number(narrowest, 1), level(["focus"]));
    tile("saturated", String(sample.saturated_px), sample.saturated_px ? "white is reached" : "none at white", sample.saturated_px ? "bad" : "good");
    spark("offset", history.map((point) => point.distance_px), tolerance.centre_px);
    spark("peak", history.map((point) => point.peak), tolerance.peak[1], 1);
    spark("width", history.map((point) => point.width_px), narrowest);
    spark("saturated", history.map((point) => point.saturated_px), null);
    byId("caption").textContent = sample.failed || !sample.frame_width_px ? "No frame · " + sample.note : (sample.centroid_px ? "Point at " + sample.centroid_px.map((v) => v.toFixed(1)).join(", ") + " in a frame of " : "Frame of ") +
      sample.frame_width_px + " × " + sample.frame_height_px + " px" + (sample.note ? " · " + sample.note : "");
    showPictureAgain();
  }

  function exposureText(sample) {
    const time = sample.exposure_s;
    const parts = [];
    if (time !== null) parts.push(time < 0.3 ? "1/" + Math.round(1 / time) + " s" : Number(time.toPrecision(3)) + " s");
    if (sample.iso !== null) parts.push("ISO " + sample.iso);
    return parts.join(", ");
  }

  function showAge() {
    const age = performance.now() - shownAt;
    // A camera doubles a long exposure for its dark frame.
    const patience = STALE_MS + (latest ? 2000 * (latest.sample.exposure_s || 0) : 0);
    const stale = !socket || (latest !== null && age > patience);
    const live = byId("live");
    live.className = socket && latest && !stale ? "on" : stale ? "stale" : "";
    byId("liveText").textContent = !socket ? "no connection to the workbench" : !latest ? "connected"
      : stale ? "no new frame for " + Math.round(age / 1000) + " s" : "live";
    document.body.classList.toggle("stale", stale && latest !== null);
    if (!socket && latest) verdict("wait", "…", "No connection to the workbench", "Its terminal says why. What is below is old; this page comes back by itself.");
  }

  // ---- drawing ---------------------------------------------------------------------------------------------------

  function fitted(canvas) {
    const ratio = window.devicePixelRatio, box = canvas.getBoundingClientRect();
    const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, width, height);
    return { pen, width, height, ratio };
  }

  function spark(id, values, line, ceiling) {
    const { pen, width, height, ratio } = fitted(byId(id).querySelector(".spark"));
    const known = values.filter((value) => value !== null && value !== undefined);
    if (known.length < 2 || height < 8 * ratio) return;
    const top = ceiling || 1.12 * Math.max(...known, line || 0, 1e-9);
    const pad = 3 * ratio;
    const y = (value) => pad + (height - 2 * pad) * (1 - Math.min(value, top) / top);
    const x = (index) => pad + (width - 2 * pad) * (values.length < 2 ? 1 : index / (values.length - 1));
    if (line !== null && line !== undefined) {
      pen.strokeStyle = colour("quiet");
      pen.globalAlpha = 0.55;
      pen.setLineDash([4 * ratio, 5 * ratio]);
      pen.lineWidth = ratio;
      pen.beginPath(); pen.moveTo(0, y(line)); pen.lineTo(width, y(line)); pen.stroke();
      pen.setLineDash([]);
      pen.globalAlpha = 1;
    }
    pen.strokeStyle = getComputedStyle(byId(id)).getPropertyValue("--state");
    pen.lineWidth = 2 * ratio;
    pen.lineJoin = "round";
    pen.beginPath();
    let down = false;
    values.forEach((value, index) => {
      if (value === null || value === undefined) { down = false; return; }
      if (down) pen.lineTo(x(index), y(value)); else pen.moveTo(x(index), y(value));
      down = true;
    });
    pen.stroke();
    const last = values[values.length - 1];
    if (last !== null && last !== undefined) {
      pen.fillStyle = pen.strokeStyle;
      pen.beginPath(); pen.arc(x(values.length - 1), y(last), 3 * ratio, 0, 7); pen.fill();
    }
  }

  function showPicture(blob) {
    const image = new Image();
    image.onload = () => { URL.revokeObjectURL(image.src); picture = image; showPictureAgain(); };
    image.onerror = () => URL.revokeObjectURL(image.src);
    image.src = URL.createObjectURL(blob);
  }

  function showPictureAgain() {
    const { pen, width, height, ratio } = fitted(byId("image"));
    if (!latest || !latest.sample.frame_width_px) return;
    const { sample, tolerance } = latest;
    const [left, top, across, down] = sample.crop_px || [0, 0, sample.frame_width_px, sample.frame_height_px];
    const scale = Math.min(width / across, height / down);
    const x0 = (width - scale * across) / 2, y0 = (height - scale * down) / 2;
    // Pixel centres have whole coordinates in the frame.
    const x = (px) => x0 + scale * (px + 0.5 - left), y = (px) => y0 + scale * (px + 0.5 - top);
    if (picture) {
      pen.imageSmoothingEnabled = scale * across < picture.naturalWidth;
      pen.drawImage(picture, x0, y0, scale * across, scale * down);
    }
    const target = sample.target_px || [(sample.frame_width_px - 1) / 2, (sample.frame_height_px - 1) / 2];
    const tx = x(target[0]), ty = y(target[1]);
    const radius = Math.max(6 * ratio, scale * tolerance.centre_px);
    pen.lineWidth = 1.5 * ratio;
    pen.strokeStyle = colour("quiet");
    pen.globalAlpha = 0.8;
    pen.beginPath(); pen.arc(tx, ty, radius, 0, 7);
    pen.moveTo(0, ty); pen.lineTo(tx - radius, ty); pen.moveTo(tx + radius, ty); pen.lineTo(width, ty);
    pen.moveTo(tx, 0); pen.lineTo(tx, ty - radius); pen.moveTo(tx, ty + radius); pen.lineTo(tx, height);
    pen.stroke();
    pen.globalAlpha = 1;
    if (!sample.centroid_px) return;
    // Open in the middle: in focus the point is smaller than any mark.
    const cx = x(sample.centroid_px[0]), cy = y(sample.centroid_px[1]), gap = 7 * ratio, arm = gap + 9 * ratio;
    pen.strokeStyle = colour(level(["centre"]) || "text");
    pen.lineWidth = 2.5 * ratio;
    pen.beginPath();
    for (const side of [-1, 1]) {
      pen.moveTo(cx + side * gap, cy); pen.lineTo(cx + side * arm, cy);
      pen.moveTo(cx, cy + side * gap); pen.lineTo(cx, cy + side * arm);
    }
    pen.stroke();
    if (Math.hypot(cx - tx, cy - ty) > radius + arm) {
      pen.lineWidth = 1.5 * ratio;
      pen.setLineDash([6 * ratio, 5 * ratio]);
      pen.beginPath(); pen.moveTo(tx, ty); pen.lineTo(cx, cy); pen.stroke();
      pen.setLineDash([]);
    }
  }

  // ---- buttons ---------------------------------------------------------------------------------------------------

  function showActions() {
    const group = byId("actions");
    if (group.children.length !== actions.length || actions.some((name, i) => group.children[i].textContent !== name)) {
      group.replaceChildren(...actions.map((name) => {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = name;
        button.addEventListener("click", () => { button.disabled = send({ type: "action", name }); });
        return button;
      }));
    }
    for (const button of group.children) {
      button.setAttribute("aria-pressed", String(button.textContent === active));
      button.disabled = false;
    }
  }

  function send(message) {
    if (!socket || socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  }

  byId("forget").addEventListener("click", () => {
    if (!send({ type: "forget" })) return;
    history = [];
  });
  window.addEventListener("resize", () => { if (latest) showSample(); });
  setInterval(showAge, 500);
  connect();
})();
