// A push of the shown orbit at its section: an impulse that is dragged or given in numbers. With it what is stored of
// this parameter point: the critical shocks of the orbit's attractor, and the edge states.

import { el, numberField, show, shortened } from "./dom.js";
import { number } from "./facts.js";

const TURN = 2 * Math.PI;
const HEAD = 9; // length of an arrow's head [px]
const FEW = 2; // edge states that are listed at once
const SHOCKS = [["smallest", []], ["shortest", [6, 4]]];

export class Push {
  /**
   * @param {Plane} plane whose picture shows the push, and which integrates it
   */
  constructor(plane) {
    Object.assign(this, { plane, view: plane.view, orbit: null, base: null, jump: null, isOn: false, drags: false, known: null });
    this.names = this.view.model.states.map((state) => state.name);
    this.asked = 0;
    this.list = el("ul", { class: "disturbances" });
    this.element = el("div", { class: "push" });
    if (plane.live) this.buildLive();
    this.element.append(this.list);
  }

  buildLive() {
    this.button = el("button", { type: "button", text: "Push this orbit", "aria-pressed": "false", on: { click: () => this.turn(!this.isOn) } });
    this.fields = el("div", { class: "bounds" });
    const go = el("button", { type: "button", text: "Integrate after the push", on: { click: () => this.go() } });
    this.hint = el("p", { class: "note" });
    this.more = el("div", { hidden: true }, this.hint, this.fields, go);
    this.element.append(el("div", { class: "controls" }, this.button), this.more);
  }

  turn(isOn) {
    this.isOn = isOn;
    this.button.setAttribute("aria-pressed", String(isOn));
    show(this.more, isOn);
    this.plane.frame.repaint();
  }

  // ---- the orbit that is pushed ------------------------------------------------------------

  /** Take the orbit that is shown; what is stored belongs to orbits of the run. */
  async show(orbit, isFollowed) {
    this.orbit = orbit;
    this.rest(this.names.map((name) => orbit.column(name)[0]));
    const asked = ++this.asked;
    this.take(null, isFollowed ? [] : null);
    if (isFollowed) return;
    const known = await this.plane.source.disturbances({ at: this.plane.indices }).catch((error) => ({ shocks: [], edges: [], notes: [error.message] }));
    if (asked === this.asked) this.take(known, known.notes);
  }

  /** Begin again without an impulse, at a state of the orbit. */
  rest(base) {
    [this.base, this.jump] = [base, base.map(() => 0)];
    if (!this.plane.live) return;
    this.fill();
    const many = this.orbit.section(this.names[0]).length > 1 ? " Of an orbit with several section points, it is the one that is selected in the diagram." : "";
    this.hint.textContent = `Drag in the plane, where the ring is the orbit's section point; or use the arrow keys and Enter there, or enter the impulse.${many}`;
  }

  fill() {
    this.fields.replaceChildren(...this.names.map((name, i) => numberField(`Impulse ${this.plane.named(name)}`, this.jump[i], (value) => {
      this.jump[i] = value;
      this.plane.frame.repaint();
    })));
  }

  /** Show the jump in the fields, without making them anew. */
  told() {
    this.fields.querySelectorAll("input").forEach((input, i) => (input.value = shortened(this.jump[i])));
    this.plane.frame.refresh();
  }

  /** Where a state is drawn in the plane: angles within half a turn of its middle. */
  drawn(state) {
    const { limits, pair, frame } = this.plane;
    return pair.map((name, k) => {
      const value = state[this.names.indexOf(name)], { angle } = k ? frame.yAxis : frame.xAxis;
      return angle ? value - TURN * Math.round((value - (limits[2 * k] + limits[2 * k + 1]) / 2) / TURN) : value;
    });
  }

  /** The jump of a state in the plane's two directions. */
  across(jump) {
    return this.plane.pair.map((name) => jump[this.names.indexOf(name)]);
  }

  // ---- dragging ----------------------------------------------------------------------------

  /** Take the pointer while a push is dragged. */
  listen(front) {
    front.addEventListener("pointerdown", (event) => {
      const place = this.isOn && event.button === 0 && this.base ? this.plane.frame.at(event) : null;
      if (!place) return;
      this.drags = true;
      front.setPointerCapture(event.pointerId);
      this.pull(place);
    });
    front.addEventListener("pointermove", (event) => this.drags && this.pull(this.plane.frame.at(event)));
    front.addEventListener("pointerup", () => this.drop(true));
    front.addEventListener("pointercancel", () => this.drop(false));
  }

  pull(place) {
    if (!place) return;
    const from = this.drawn(this.base);
    this.plane.pair.forEach((name, k) => (this.jump[this.names.indexOf(name)] = place[k] - from[k]));
    this.told();
  }

  /** Change the jump by hundredths of what the plane shows. */
  nudge(dx, dy) {
    const [x0, x1, y0, y1] = this.plane.limits, steps = [(dx * (x1 - x0)) / 100, (dy * (y1 - y0)) / 100];
    this.plane.pair.forEach((name, k) => (this.jump[this.names.indexOf(name)] += steps[k]));
    this.told();
  }

  drop(goes) {
    if (!this.drags) return;
    this.drags = false;
    if (goes) this.go();
  }

  /** Integrate from the pushed state, and say where it leads. */
  go() {
    const state = Object.fromEntries(this.names.map((name, i) => [name, this.base[i] + this.jump[i]]));
    const told = jumpOf(this.jump, this.names, this.plane) || "nothing";
    const own = this.orbit.attrs.attractor ?? null; // another orbit may be shown at the end
    return this.plane.integrate(state, (end) => `Pushed by ${told}, this orbit ${endOf(end, own)}`);
  }

  /** Push by a stored shock, from the state where it was found. */
  tryShock(shock) {
    this.turn(true);
    this.base = shock.from;
    this.jump = [...shock.jump];
    this.fill();
    this.hint.textContent = "The push begins at the state for which this shock was found.";
    this.plane.frame.repaint();
    return this.go();
  }

  // ---- what is stored ----------------------------------------------------------------------

  take(known, notes) {
    this.known = known;
    const own = this.orbit.attrs.attractor ?? null;
    this.shocks = own === null ? null : known?.shocks.find((one) => one.attractor === own) ?? null;
    const lines = [];
    if (this.shocks) for (const [which] of SHOCKS) lines.push(this.shockLine(which));
    if (known?.edges.length) lines.push(this.edgeLines(known.edges));
    for (const note of notes ?? []) lines.push(el("li", { class: "muted", text: `${note[0].toUpperCase()}${note.slice(1)}` }));
    this.list.replaceChildren(...lines);
    show(this.list, lines.length > 0);
    this.plane.frame.repaint();
  }

  shockLine(which) {
    const shock = this.shocks[which], { letter, largest, states } = this.shocks;
    const named = states.map((name) => this.plane.named(name)).join(", ");
    const what = which === "smallest" ? `Smallest critical shock of ${letter} (${named}; solid arrow)` : `Shortest way out of ${letter}'s basin at the section (all states; dashed arrow)`;
    if (!shock) return el("li", { text: `${what}: none up to ${number(largest)} of the states' scales leads away.` });
    const size = shock.low === null || Math.abs(shock.high - shock.low) < 1e-4 * shock.high ? number(shock.high) : `${number(shock.low)} to ${number(shock.high)}`;
    const when = shock.startable ? "" : `, at phase ${number(shock.phase)} of the ${this.view.model.forced ? "drive period" : "orbit"}, so it is not drawn`;
    const leads = /^[A-Z]+$/.test(shock.leads_to) ? `leads to ${shock.leads_to}` : shock.leads_to === "elsewhere" ? "leads elsewhere" : shock.leads_to;
    const line = el("li", { text: `${what}: ${size} of the scales, ${jumpOf(shock.jump, this.names, this.plane)}${when}; ${leads}. ` });
    if (this.plane.live && shock.startable) line.append(el("button", { type: "button", text: "Try it", "aria-label": `${what}: try it`, on: { click: () => this.tryShock(shock) } }));
    return line;
  }

  /** The edge states; of more than a few one sees the number first. */
  edgeLines(edges) {
    const listed = el("ul", {}, ...edges.map((edge) => el("li", { text: edgeSentence(edge) })));
    const flat = this.names.length > 2 ? ", drawn without their other states" : "";
    const summary = el("summary", { text: `${edges.length === 1 ? "1 edge state" : `${edges.length} edge states`} (diamonds${flat})` });
    return el("li", {}, el("details", { open: edges.length <= FEW }, summary, listed));
  }

  // ---- painting ----------------------------------------------------------------------------

  /** Paint the edge states, below the path of a start. */
  paint(ctx, frame, colours) {
    for (const edge of this.known?.edges ?? []) for (const point of edge.section) diamond(ctx, frame, this.drawn(point), edge.multipliers ? 5 : 3, colours);
  }

  /** Paint the arrows over all else. */
  paintFront(ctx, frame, colours) {
    for (const [which, dash] of SHOCKS) {
      const shock = this.shocks?.[which];
      if (shock?.startable) arrow(ctx, frame, this.drawn(shock.from), this.across(shock.jump), dash, colours.ink, colours.card);
    }
    if (!this.isOn || !this.base) return;
    const from = this.drawn(this.base);
    arrow(ctx, frame, from, this.across(this.jump), [], colours.accent, colours.card);
    for (const [width, colour] of [[4.5, colours.card], [2.5, colours.accent]]) {
      ctx.beginPath();
      ctx.arc(frame.x(from[0]), frame.y(from[1]), 6, 0, TURN);
      ctx.strokeStyle = colour;
      ctx.lineWidth = width;
      ctx.stroke();
    }
  }
}

function diamond(ctx, frame, [x, y], size, colours) {
  const [px, py] = [frame.x(x), frame.y(y)];
  ctx.beginPath();
  ctx.moveTo(px - size, py);
  ctx.lineTo(px, py - size);
  ctx.lineTo(px + size, py);
  ctx.lineTo(px, py + size);
  ctx.closePath();
  ctx.fillStyle = colours.card;
  ctx.strokeStyle = colours.ink;
  ctx.lineWidth = 1.4;
  ctx.fill();
  ctx.stroke();
}

/** An arrow from a place by a jump, with a rim that parts it from what it lies on. */
function arrow(ctx, frame, [x, y], [dx, dy], dash, colour, rim) {
  const [px, py, qx, qy] = [frame.x(x), frame.y(y), frame.x(x + dx), frame.y(y + dy)];
  const length = Math.hypot(qx - px, qy - py);
  if (length < 1) return;
  const [ux, uy] = [(qx - px) / length, (qy - py) / length], head = Math.min(HEAD, length / 2);
  for (const [width, stroke, lines] of [[5, rim, []], [2.2, colour, dash]]) {
    ctx.strokeStyle = stroke;
    ctx.lineWidth = width;
    ctx.setLineDash(lines);
    ctx.beginPath();
    ctx.moveTo(px, py);
    ctx.lineTo(qx, qy);
    ctx.stroke();
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.moveTo(qx - head * (ux + 0.5 * uy), qy - head * (uy - 0.5 * ux));
    ctx.lineTo(qx, qy);
    ctx.lineTo(qx - head * (ux - 0.5 * uy), qy - head * (uy + 0.5 * ux));
    ctx.stroke();
  }
}

/** The jumps of the states that jump, in words. */
function jumpOf(jump, names, plane) {
  const unit = (i) => {
    const { unit: found } = plane.view.model.states[i];
    return found && found !== "1" ? ` ${found}` : "";
  };
  return names.map((name, i) => (jump[i] ? `${plane.named(name)} ${jump[i] > 0 ? "+" : "−"}${number(Math.abs(jump[i]))}${unit(i)}` : "")).filter(Boolean).join(", ");
}

/** Where a pushed orbit goes. */
function endOf({ label, motion, status, periods, period, attractor }, own) {
  const what = label ?? [period ? `period ${period}` : status, motion].filter(Boolean).join(", ");
  const after = periods ? `, after ${periods} periods.` : ".";
  if (attractor !== null) return `${attractor === own ? "comes back to" : "is led to"} ${what}${after}`;
  return period ? `is led to ${what}${after}` : `ends on no attractor of the run: ${what}${after}`;
}

function edgeSentence({ between, kind, period, section, multipliers, eigenvalues }) {
  const values = (multipliers ?? eigenvalues ?? []).map(([re, im]) => (Math.abs(im) < 1e-12 ? number(re) : `${number(re)} ${im < 0 ? "−" : "+"} ${number(Math.abs(im))}i`));
  const what = multipliers ? `, period ${period}, multipliers ${values.join(", ")}` : eigenvalues ? `, eigenvalues ${values.join(", ")} 1/s` : `, ${section.length} section points`;
  return `Between ${between.join(" and ")}: ${kind}${what}.`;
}
