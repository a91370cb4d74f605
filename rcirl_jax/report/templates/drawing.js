// Geometry and drawing of a moment; `current` (the case), `time` and `colours` are
// those of player.js.
const INK = "#222", PALE = "#999";
const PAST_S = 5, NEXT_S = 8; // window of the station-time graph
const BELOW_M = 20, ABOVE_M = 60; // and what is driven in MORE_S at the present speed
const MORE_S = 3;
const IN_PATH_M = 0.2; // beyond the half widths a body is beside the path

// ------------------------------------------------------------------ geometry

const mix = (a, b, f) => a + f * (b - a);

function along(values, s) {
  const u = Math.min(Math.max(s / current.road_step, 0), values.length - 1);
  const i = Math.min(Math.floor(u), values.length - 2);
  return mix(values[i], values[i + 1], u - i);
}

function pathOf(drive) {
  return drive.path_l.length > 1 ? drive.path_l : current.path_l;
}

function world(s, l) {
  const end = (current.x.length - 1) * current.road_step;
  const beyond = s - Math.min(Math.max(s, 0), end);
  const turn = along(current.turn, s);
  return {
    x: along(current.x, s) + beyond * Math.cos(turn) - l * Math.sin(turn),
    y: along(current.y, s) + beyond * Math.sin(turn) + l * Math.cos(turn),
    turn,
  };
}

// A point seen from the reference line at `station`.
function seen(s, l, station) {
  const p = world(s, l), o = world(station, 0);
  const c = Math.cos(o.turn), n = Math.sin(o.turn);
  const dx = p.x - o.x, dy = p.y - o.y;
  return { x: dx * c + dy * n, y: dy * c - dx * n, turn: p.turn - o.turn };
}

// ------------------------------------------------------------------ moments

const frames = (drive) => drive.s.length;
const endOf = (drive) => drive.t[frames(drive) - 1];

function agentsAt(drive, i) {
  const flat = drive.agents[i], found = new Map();
  for (let k = 0; k < flat.length; k += 4) found.set(flat[k], flat.slice(k + 1, k + 4));
  return found;
}

function moment(drive) {
  const last = frames(drive) - 1;
  const i = Math.min(Math.max(Math.floor(time / current.frame_s + 1e-9) - 1, 0), last);
  const j = Math.min(i + 1, last), gap = drive.t[j] - drive.t[i];
  const f = gap > 0 ? Math.min(Math.max((time - drive.t[i]) / gap, 0), 1) : 0;
  const now = { i, plan: drive.plan[i], red: drive.red[i] };
  for (const name of ["s", "l", "heading", "v", "a"]) {
    now[name] = mix(drive[name][i], drive[name][j], f);
  }
  now.clearance = drive.clearance[i];
  const next = agentsAt(drive, j);
  now.agents = [...agentsAt(drive, i)].map(([slot, [s, l, heading]]) => {
    const to = next.get(slot) || [s, l, heading];
    return { slot, s: mix(s, to[0], f), l: mix(l, to[1], f), heading: mix(heading, to[2], f) };
  });
  return now;
}

// ------------------------------------------------------------------ drawing

function surface(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const wide = canvas.clientWidth, high = canvas.clientHeight;
  canvas.width = Math.round(wide * ratio);
  canvas.height = Math.round(high * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, wide, high);
  pen.font = "11px system-ui, sans-serif";
  pen.lineJoin = "round";
  return { pen, wide, high };
}

function line(pen, points, colour, width, dash) {
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(x, y);
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.setLineDash(dash || []);
  pen.stroke();
  pen.setLineDash([]);
}

function box(pen, pose, size, scale, fill, kind) {
  const [long, broad] = [size[0] * scale, size[1] * scale];
  pen.save();
  pen.translate(pose.x, pose.y);
  pen.rotate(-pose.turn);
  pen.fillStyle = fill;
  pen.strokeStyle = INK;
  pen.lineWidth = kind === "ego" ? 2.5 : 1;
  pen.beginPath();
  if (kind === "pedestrian") pen.arc(0, 0, Math.max(0.5 * long, 4), 0, 2 * Math.PI);
  else pen.rect(-long / 2, -broad / 2, long, broad);
  pen.fill();
  pen.stroke();
  pen.beginPath();
  if (kind === "static") {
    pen.moveTo(-long / 2, -broad / 2);
    pen.lineTo(long / 2, broad / 2);
    pen.moveTo(-long / 2, broad / 2);
    pen.lineTo(long / 2, -broad / 2);
    pen.stroke();
  } else if (kind !== "pedestrian") {
    pen.moveTo(long / 2, 0);
    pen.lineTo(long / 6, broad / 2);
    pen.lineTo(long / 6, -broad / 2);
    pen.fillStyle = kind === "ego" ? "#fff" : INK;
    pen.fill();
  }
  pen.restore();
}

function birdsEye(canvas, drive) {
  const { pen, wide, high } = surface(canvas), now = moment(drive);
  const behind = wide < 480 ? 15 : 30, shown = wide < 480 ? 60 : 100;
  const scale = wide / shown;
  const place = (s, l) => {
    const p = seen(s, l, now.s);
    return { x: (p.x + behind) * scale, y: high / 2 - p.y * scale, turn: p.turn };
  };
  const stations = [];
  for (let s = now.s - behind - 15; s < now.s + shown + 15; s += 2) stations.push(s);
  const ribbon = (l) => stations.map((s) => {
    const p = place(s, typeof l === "number" ? l : along(l, s));
    return [p.x, p.y];
  });
  const [left, right] = current.edges;
  pen.fillStyle = "#f2f2f2";
  pen.beginPath();
  for (const [x, y] of [...ribbon(left), ...ribbon(right).reverse()]) pen.lineTo(x, y);
  pen.fill();
  for (const edge of current.edges) line(pen, ribbon(edge), INK, 1.5);
  for (const mark of current.marks) line(pen, ribbon(mark), PALE, 1, [8, 6]);
  line(pen, ribbon(pathOf(drive)), drive.look.colour, 1, [2, 4]);
  current.lines.forEach((s, number) => {
    if (s < -1000) return;
    const a = place(s, left), b = place(s, right);
    const stops = now.red.includes(number);
    line(pen, [[a.x, a.y], [b.x, b.y]], stops ? colours.stop : colours.open, stops ? 4 : 2,
      stops ? [] : [4, 3]);
  });
  for (const agent of now.agents) {
    const [kind, long, broad] = current.bodies[agent.slot];
    const pose = place(agent.s, agent.l);
    pose.turn += agent.heading;
    box(pen, pose, [long, broad], scale, colours[kind], kind);
  }
  const ego = place(now.s, now.l);
  ego.turn += now.heading;
  box(pen, ego, current.ego, scale, drive.look.colour, "ego");
  pen.fillStyle = INK;
  line(pen, [[8, high - 8], [8 + 10 * scale, high - 8]], INK, 2);
  pen.fillText("10 m", 12, high - 13);
  return now;
}

function stationTime(canvas, drive, now) {
  const { pen, wide, high } = surface(canvas);
  const left = 48, low = high - 30, above = ABOVE_M + MORE_S * Math.max(now.v, 0);
  const px = (t) => left + (wide - left) * (t - time + PAST_S) / (PAST_S + NEXT_S);
  const py = (s) => low - low * (s - now.s + BELOW_M) / (BELOW_M + above);
  const first = Math.max(Math.floor((time - PAST_S) / current.frame_s) - 2, 0);
  const last = (d) => Math.min(Math.ceil((time + NEXT_S) / current.frame_s), frames(d));
  const when = (d, i) => d.t[i];
  pen.save();
  pen.beginPath();
  pen.rect(left, 0, wide - left, low);
  pen.clip();
  const step = px(current.frame_s) - px(0);
  for (let i = first; i < last(drive); i += 1) {
    for (const [slot, [s, l, heading]] of agentsAt(drive, i)) {
      const [kind, long, broad] = current.bodies[slot];
      const c = Math.abs(Math.cos(heading)), n = Math.abs(Math.sin(heading));
      const beside = Math.abs(l - along(pathOf(drive), s)) - 0.5 * (long * n + broad * c);
      if (beside - 0.5 * current.ego[1] >= IN_PATH_M) continue;
      const half = 0.5 * (long * c + broad * n);
      pen.globalAlpha = 0.55;
      pen.fillStyle = colours[kind];
      pen.fillRect(px(when(drive, i)) - step, py(s + half), step + 0.5, py(s - half) - py(s + half));
      pen.globalAlpha = 1;
    }
    for (const number of drive.red[i]) {
      const y = py(current.lines[number]);
      line(pen, [[px(when(drive, i)) - step, y], [px(when(drive, i)), y]], colours.stop, 4);
    }
  }
  for (const other of [...current.drives.filter((d) => d !== drive), drive]) {
    const points = [];
    for (let i = first; i < last(other); i += 1) points.push([px(when(other, i)), py(other.s[i])]);
    line(pen, points, other.look.colour, other === drive ? 3 : 1.2, other.look.dash);
  }
  const plan = now.plan.map((ahead, k) => [px(time + k + 1), py(now.s + ahead)]);
  if (plan.length) line(pen, [[px(time), py(now.s)], ...plan], INK, 1.5, [1, 3]);
  line(pen, [[px(time), 0], [px(time), low]], INK, 1, [2, 2]);
  pen.restore();
  pen.fillStyle = "#333";
  pen.textAlign = "right";
  const tick = above > 110 ? 40 : 20;
  for (let m = 0; m <= above - 10; m += tick) {
    const y = py(now.s + m);
    pen.fillText(m ? `+${m}` : "0", left - 4, y + 4);
    line(pen, [[left, y], [wide, y]], "#ddd", 0.7);
  }
  pen.textAlign = "center";
  for (let t = Math.ceil((time - PAST_S) / 2) * 2; t < time + NEXT_S - 1; t += 2) {
    if (t >= 0) pen.fillText(`${t}`, px(t), high - 17);
  }
  pen.fillText("time, s", (left + wide) / 2, high - 4);
  pen.save();
  pen.translate(11, low / 2);
  pen.rotate(-Math.PI / 2);
  pen.fillText("ahead of the ego, m", 0, 0);
  pen.restore();
  line(pen, [[left, 0], [left, low], [wide, low]], "#888", 1);
}
