// Wheel, drag, box and pinch on a picture with axes: all end in a new window of it.

const SLOP = 4;

/** A window no smaller than doubles can tell apart, and not much larger than all there is. */
export function bounded([x0, x1, y0, y1], full) {
  return [...boundedSpan(x0, x1, full[0], full[1]), ...boundedSpan(y0, y1, full[2], full[3])];
}

function boundedSpan(low, high, fullLow, fullHigh) {
  const middle = (low + high) / 2, size = Math.max(Math.abs(low), Math.abs(high), 1e-300);
  const least = 256 * Number.EPSILON * size, most = 4 * (fullHigh - fullLow);
  const span = Math.min(most, Math.max(least, high - low));
  const centre = Math.min(fullHigh + span / 2, Math.max(fullLow - span / 2, middle));
  return span === high - low && centre === middle ? [low, high] : [centre - span / 2, centre + span / 2];
}

/** A window scaled about a place: fx and fy below 1 zoom in. */
export function scaled([x0, x1, y0, y1], x, y, fx, fy) {
  return [x + (x0 - x) * fx, x + (x1 - x) * fx, y + (y0 - y) * fy, y + (y1 - y) * fy];
}

export class Gestures {
  /**
   * @param {HTMLElement} element
   * @param {{box: function(): Object, window: function(): number[], set: function(number[]): void,
   *   tap?: function(number, number): void, hover?: function(number|null, number|null): void, reset: function(): void,
   *   marked?: function(number[]|null): void, level?: boolean, takesWheel?: function(): boolean}} picture places are in CSS pixels of the element;
   *   `level` keeps the vertical axis as it is
   */
  constructor(element, picture) {
    Object.assign(this, { element, picture });
    this.pointers = new Map();
    this.mode = null;
    const on = (name, call, options) => element.addEventListener(name, call.bind(this), options);
    on("wheel", this.wheel, { passive: false });
    on("pointerdown", this.down);
    on("pointermove", this.move);
    on("pointerup", this.up);
    on("pointercancel", this.up);
    on("pointerleave", () => this.picture.hover?.(null, null));
    on("dblclick", () => picture.reset());
  }

  place(event) {
    const rect = this.element.getBoundingClientRect();
    return [event.clientX - rect.left, event.clientY - rect.top];
  }

  data([px, py], window = this.picture.window()) {
    const box = this.picture.box(), [x0, x1, y0, y1] = window;
    return [x0 + ((px - box.left) / box.width) * (x1 - x0), y1 - ((py - box.top) / box.height) * (y1 - y0)];
  }

  wheel(event) {
    if (!event.ctrlKey && !(this.picture.takesWheel?.() ?? true)) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1;
    const factor = Math.exp(Math.max(-1, Math.min(1, event.deltaY * lines * (event.ctrlKey ? 0.01 : 0.0016))));
    const [px, py] = this.place(event), box = this.picture.box(), [x, y] = this.data([px, py]);
    const level = this.picture.level || py > box.top + box.height, upright = px < box.left && !this.picture.level;
    this.picture.set(scaled(this.picture.window(), x, y, upright ? 1 : factor, level ? 1 : factor));
  }

  down(event) {
    if (event.button !== 0) return;
    try {
      this.element.setPointerCapture(event.pointerId);
    } catch {
      // a pointer that is gone already
    }
    this.pointers.set(event.pointerId, this.place(event));
    this.began = { window: this.picture.window(), places: [...this.pointers.values()] };
    if (this.pointers.size === 2) this.mode = "pinch";
    else if (event.shiftKey) this.mode = "box";
    else this.mode = "tap";
  }

  move(event) {
    const place = this.place(event);
    if (!this.pointers.has(event.pointerId)) {
      this.picture.hover?.(...place);
      return;
    }
    this.pointers.set(event.pointerId, place);
    const places = [...this.pointers.values()], [from] = this.began.places;
    if (this.mode === "tap" && Math.hypot(place[0] - from[0], place[1] - from[1]) > SLOP) this.mode = "pan";
    if (this.mode === "pan") this.pan(from, place);
    else if (this.mode === "pinch" && places.length === 2) this.pinch(this.began.places, places);
    else if (this.mode === "box") this.picture.marked?.([...from, ...place]);
  }

  pan(from, to) {
    const box = this.picture.box(), [x0, x1, y0, y1] = this.began.window;
    const dx = ((to[0] - from[0]) / box.width) * (x1 - x0);
    const dy = this.picture.level ? 0 : ((to[1] - from[1]) / box.height) * (y1 - y0);
    this.picture.set([x0 - dx, x1 - dx, y0 + dy, y1 + dy]);
  }

  pinch([a, b], [c, d]) {
    const was = Math.hypot(a[0] - b[0], a[1] - b[1]), is = Math.max(20, Math.hypot(c[0] - d[0], c[1] - d[1]));
    const factor = was / is, middle = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    const [x, y] = this.data(middle, this.began.window);
    const window = scaled(this.began.window, x, y, factor, this.picture.level ? 1 : factor);
    const kept = this.began;
    this.began = { window, places: [middle] };
    this.pan(middle, [(c[0] + d[0]) / 2, (c[1] + d[1]) / 2]);
    this.began = kept;
  }

  up(event) {
    if (!this.pointers.has(event.pointerId)) return;
    const place = this.place(event), cancelled = event.type === "pointercancel";
    this.pointers.delete(event.pointerId);
    if (this.mode === "tap" && !cancelled) this.picture.tap?.(...place);
    if (this.mode === "box") this.endBox(place, cancelled);
    // the finger that stays goes on from where it is
    this.began = { window: this.picture.window(), places: [...this.pointers.values()] };
    this.mode = this.pointers.size ? "pan" : null;
  }

  endBox(place, cancelled) {
    const [from] = this.began.places;
    this.picture.marked?.(null);
    if (cancelled || Math.abs(place[0] - from[0]) < SLOP || Math.abs(place[1] - from[1]) < SLOP) return;
    const [xa, ya] = this.data(from), [xb, yb] = this.data(place);
    this.picture.set([Math.min(xa, xb), Math.max(xa, xb), Math.min(ya, yb), Math.max(ya, yb)]);
  }
}
