// The time that a moving drawing, its portraits and its series share.

/** Factors of real time that the speed goes through. */
export const SPEEDS = [1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8, 16, 32, 64];

const PLEASANT_S = 4;

export class Clock {
  constructor() {
    this.duration = 0;
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.listeners = new Set();
    this.last = null;
  }

  on(listener) {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  tell() {
    for (const listener of this.listeners) listener(this);
  }

  /** Begin anew with another duration [s], at a speed at which it is seen in some seconds. */
  reset(duration, keepSpeed = false) {
    this.duration = duration;
    this.time = keepSpeed && duration > 0 ? this.time % duration : 0;
    if (!keepSpeed) {
      const wanted = Math.log(duration / PLEASANT_S);
      this.speed = SPEEDS.reduce((a, b) => (Math.abs(Math.log(b) - wanted) < Math.abs(Math.log(a) - wanted) ? b : a), 1);
    }
    this.tell();
  }

  seek(time) {
    this.time = Math.min(Math.max(0, time), this.duration);
    this.tell();
  }

  play() {
    if (this.playing || !(this.duration > 0)) return;
    this.playing = true;
    this.last = null;
    this.frame = requestAnimationFrame((now) => this.step(now));
    this.tell();
  }

  pause() {
    this.playing = false;
    cancelAnimationFrame(this.frame);
    this.tell();
  }

  step(now) {
    if (!this.playing) return;
    if (this.last !== null && this.duration > 0) {
      const elapsed = Math.min(0.1, (now - this.last) / 1000);
      this.time = (this.time + elapsed * this.speed) % this.duration;
      this.tell();
    }
    this.last = now;
    this.frame = requestAnimationFrame((next) => this.step(next));
  }
}

/** Index of the last of ascending `times` that is not after `time`, and the part of the way to the next. */
export function locate(times, time) {
  let low = 0, high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  const step = times[high] - times[low];
  return [low, high, step > 0 ? Math.min(1, Math.max(0, (time - times[low]) / step)) : 0];
}
