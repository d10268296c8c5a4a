// The explorer of a run: drag and zoom the path, move the slider through time.
(() => {
  "use strict";
  const box = document.getElementById("explorer");
  const data = JSON.parse(document.getElementById("explorer-data").textContent);
  const find = (name) => box.querySelector("." + name);
  const map = find("map"), strip = find("strip"), picture = find("picture");
  const slider = find("time"), play = find("play"), said = find("said");
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  const { t, x: xs, y: ys, z: zs, heading, error } = Object.fromEntries(
    Object.entries(data.floats).map(([name, text]) => [name, floats(text)]));
  const truth = { x: floats(data.truth.x), z: floats(data.truth.z) };
  const inliers = new Uint16Array(bytes(data.inliers).buffer), states = bytes(data.state);
  const n = xs.length;
  const stateOf = (k) => data.states[states[k]];
  const moments = data.moments.map((m) => ({
    frame: m.frame, image: null, jpeg: m.jpeg, n: m.n,
    points: bytes(m.points), tracked: bytes(m.tracked),
  }));
  const most = (values) => values.reduce((a, b) => (b > a ? b : a), 0);  // NaN is not greater
  const greatest = most(error), mostInliers = Math.max(most(inliers), 1);
  const colour = (name) => getComputedStyle(box).getPropertyValue("--" + name).trim();
  const ofState = { WEAK: "#f59e0b", INERTIAL: "#06b6d4", LOST: "#ef4444", DROPPED: "#8b5cf6" };
  let now = 0, view = null, timer = null, wanted = false;

  const context = (canvas) => {
    const scale = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    const c = canvas.getContext("2d");
    c.setTransform(scale, 0, 0, scale, 0, 0);
    c.clearRect(0, 0, width, height);
    return [c, width, height];
  };

  // view: the position in metres at the middle of the canvas, and pixels per metre
  const whole = () => {
    const range = (...several) => {
      let low = Infinity, high = -Infinity;
      several.forEach((values) => values.forEach((v) => {
        if (v < low) low = v;
        if (v > high) high = v;
      }));
      return [low, high];
    };
    const [x0, x1] = range(xs, truth.x), [z0, z1] = range(zs, truth.z);
    const width = map.clientWidth, height = map.clientHeight;
    const scale = 0.88 * Math.min(width / Math.max(x1 - x0, 1e-6), height / Math.max(z1 - z0, 1e-6));
    view = { x: (x0 + x1) / 2, z: (z0 + z1) / 2, scale: Math.min(scale, 1e5) };
  };
  const place = (x, z) => [
    map.clientWidth / 2 + (x - view.x) * view.scale,
    map.clientHeight / 2 - (z - view.z) * view.scale,
  ];
  const line = (c, lineX, lineZ) => {
    let lastX = NaN, lastY = NaN;
    c.beginPath();
    lineX.forEach((x, k) => {
      const [px, py] = place(x, lineZ[k]);  // steps of less than half a pixel are skipped
      if (Number.isNaN(px) || (k + 1 < n && Math.abs(px - lastX) + Math.abs(py - lastY) < 0.5)) return;
      c.lineTo(px, py);
      lastX = px; lastY = py;
    });
    c.stroke();
  };
  const eachBad = (visit) => states.forEach((_, k) => {
    const colourOf = ofState[stateOf(k)];
    if (colourOf) visit(k, colourOf);
  });

  const drawMap = () => {
    const [c, width, height] = context(map);
    c.lineJoin = "round";
    c.strokeStyle = "#94a3b8"; c.globalAlpha = 0.65; c.lineWidth = 4;
    line(c, truth.x, truth.z);
    c.globalAlpha = 1; c.strokeStyle = "#3b82f6"; c.lineWidth = 1.6;
    line(c, xs, zs);
    eachBad((k, colourOf) => {
      c.fillStyle = colourOf;
      c.beginPath(); c.arc(...place(xs[k], zs[k]), 2.5, 0, 7); c.fill();
    });
    const [px, py] = place(xs[now], zs[now]);
    if (truth.x.length === n) {  // the error as a line to the true position
      c.strokeStyle = "#ef4444"; c.lineWidth = 1.5;
      c.beginPath(); c.moveTo(px, py); c.lineTo(...place(truth.x[now], truth.z[now])); c.stroke();
    }
    c.fillStyle = c.strokeStyle = colour("ink"); c.lineWidth = 2.5;
    c.beginPath(); c.arc(px, py, 5, 0, 7); c.fill();
    const angle = heading[now] * Math.PI / 180;  // where the camera looks
    c.beginPath(); c.moveTo(px, py); c.lineTo(px + 15 * Math.sin(angle), py - 15 * Math.cos(angle));
    c.stroke();
    // a bar of a round length
    const about = 90 / view.scale, power = 10 ** Math.floor(Math.log10(about));
    const length = [5, 2, 1].map((f) => f * power).find((v) => v <= about) || power;
    c.strokeStyle = c.fillStyle = colour("muted"); c.lineWidth = 2;
    c.beginPath(); c.moveTo(12, height - 12); c.lineTo(12 + length * view.scale, height - 12);
    c.stroke();
    c.font = "12px system-ui, sans-serif";
    c.fillText(`${+length.toPrecision(1)}${data.unit}`, 12, height - 18);
  };

  const drawStrip = () => {
    const [c, width, height] = context(strip);
    const at = (k) => (k / Math.max(n - 1, 1)) * (width - 2) + 1;
    c.globalAlpha = 0.5;
    eachBad((k, colourOf) => {
      c.fillStyle = colourOf;
      c.fillRect(at(k) - 1, 0, Math.max(2, width / n), height);
    });
    c.globalAlpha = 1;
    c.fillStyle = colour("muted");
    moments.forEach((moment) => c.fillRect(at(moment.frame), height - 3, 1, 3));
    c.strokeStyle = greatest > 0 ? "#ef4444" : "#3b82f6"; c.lineWidth = 1.3; c.beginPath();
    (greatest > 0 ? error : inliers).forEach((v, k) => {
      if (!Number.isNaN(v)) c.lineTo(at(k), height - 5 - (v / (greatest || mostInliers)) * (height - 10));
    });
    c.stroke();
    c.strokeStyle = colour("ink"); c.lineWidth = 1;
    c.beginPath(); c.moveTo(at(now), 0); c.lineTo(at(now), height); c.stroke();
  };

  const nearest = (frame) => {
    let best = null;
    moments.forEach((m) => {
      if (!best || Math.abs(m.frame - frame) < Math.abs(best.frame - frame)) best = m;
    });
    return best;
  };
  const drawPicture = () => {
    const moment = nearest(now);
    if (!moment) { picture.hidden = true; return null; }
    if (!moment.image) {
      moment.image = new Image();
      moment.image.onload = later;
      moment.image.src = "data:image/jpeg;base64," + moment.jpeg;
    }
    const image = moment.image;
    if (!image.complete || !image.naturalWidth) return moment;
    picture.style.aspectRatio = `${image.naturalWidth} / ${image.naturalHeight}`;
    const [c, width, height] = context(picture);
    c.drawImage(image, 0, 0, width, height);
    for (let k = 0; k < moment.n; k++) {
      const tracked = moment.tracked[k >> 3] & (128 >> (k & 7));
      c.fillStyle = tracked ? "#34d399" : "#fbbf24";
      const x = (moment.points[2 * k] / 255) * width, y = (moment.points[2 * k + 1] / 255) * height;
      c.fillRect(x - 1, y - 1, tracked ? 2.6 : 1.6, tracked ? 2.6 : 1.6);
    }
    return moment;
  };

  const draw = () => {
    wanted = false;
    if (!view) whole();
    drawMap(); drawStrip();
    const moment = drawPicture();
    const parts = [`frame ${now}`, `${t[now].toFixed(2)} s`, stateOf(now), `${inliers[now]} inliers`];
    if (!Number.isNaN(error[now])) parts.push(`error ${error[now].toPrecision(3)} m`);
    const fixed = (value, decimals) => (+value.toFixed(decimals) || 0).toFixed(decimals);  // no -0
    const position = [xs, ys, zs].map((values) => fixed(values[now], 2)).join(", ");
    parts.push(`at (${position})${data.unit}`, `heading ${fixed(heading[now], 1)}°`);
    if (moment) {
      const apart = moment.frame - now, plural = Math.abs(apart) === 1 ? "" : "s";
      const when = `${Math.abs(apart)} frame${plural} ${apart < 0 ? "earlier" : "later"}`;
      parts.push(`image of frame ${moment.frame}${apart ? ", " + when : ""}`);
    }
    said.textContent = parts.join(" · ");
    slider.value = now;
    slider.setAttribute("aria-valuetext", parts.slice(0, 3).join(", "));
  };
  const later = () => { if (!wanted) { wanted = true; requestAnimationFrame(draw); } };
  const go = (k) => { now = Math.max(0, Math.min(n - 1, Math.round(k))); later(); };
  const zoom = (factor, px, py) => {
    const x = view.x + (px - map.clientWidth / 2) / view.scale;
    const z = view.z - (py - map.clientHeight / 2) / view.scale;
    view.scale = Math.max(1e-4, Math.min(1e6, view.scale * factor));
    view.x = x - (px - map.clientWidth / 2) / view.scale;
    view.z = z + (py - map.clientHeight / 2) / view.scale;
    later();
  };
  const middle = (factor) => zoom(factor, map.clientWidth / 2, map.clientHeight / 2);

  slider.max = n - 1;
  slider.addEventListener("input", () => go(+slider.value));
  find("before").addEventListener("click", () => go(now - 1));
  find("after").addEventListener("click", () => go(now + 1));
  const framesOfImages = moments.map((m) => m.frame).sort((a, b) => a - b);
  find("image-before").addEventListener("click", () => {
    go(framesOfImages.findLast((frame) => frame < now) ?? now);
  });
  find("image-after").addEventListener("click", () => {
    go(framesOfImages.find((frame) => frame > now) ?? now);
  });
  find("closer").addEventListener("click", () => middle(1.5));
  find("farther").addEventListener("click", () => middle(1 / 1.5));
  find("all").addEventListener("click", () => { whole(); later(); });
  play.addEventListener("click", () => {
    if (timer) { clearInterval(timer); timer = null; play.textContent = "Play"; return; }
    play.textContent = "Stop";
    if (now === n - 1) go(0);
    const step = Math.max(1, Math.round(n / 400));
    timer = setInterval(() => { if (now === n - 1) play.click(); else go(now + step); }, 50);
  });
  map.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }, { passive: false });

  // one finger drags, two fingers zoom, a click selects the nearest frame
  const fingers = new Map();
  let moved = 0;
  map.addEventListener("pointerdown", (event) => {
    map.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]); moved = 0;
  });
  map.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const after = [event.offsetX, event.offsetY];
    const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    if (others.length) {
      const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
      zoom(apart(after, others[0]) / apart(before, others[0]), ...others[0]);
    } else {
      view.x -= (after[0] - before[0]) / view.scale;
      view.z += (after[1] - before[1]) / view.scale;
      later();
    }
    moved += Math.hypot(after[0] - before[0], after[1] - before[1]);
    fingers.set(event.pointerId, after);
  });
  const up = (event) => {
    if (fingers.delete(event.pointerId) && moved < 4 && event.type === "pointerup") {
      let best = 0, least = Infinity;
      xs.forEach((x, k) => {
        const [px, py] = place(x, zs[k]);
        const d = Math.hypot(px - event.offsetX, py - event.offsetY);
        if (d < least) { least = d; best = k; }
      });
      if (least < 40) go(best);
    }
  };
  map.addEventListener("pointerup", up);
  map.addEventListener("pointercancel", up);
  const seek = (event) => {
    if (event.buttons || event.type === "pointerdown") go((event.offsetX / strip.clientWidth) * (n - 1));
  };
  strip.addEventListener("pointerdown", seek);
  strip.addEventListener("pointermove", seek);
  new ResizeObserver(later).observe(box);
  later();
})();
