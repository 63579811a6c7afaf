// The cells of a copy: which of them a diagram shows, in the order in which the server would send them.

/** Number of an index in rows of C order. */
function strides(shape) {
  const found = new Array(shape.length).fill(1);
  for (let i = shape.length - 2; i >= 0; i--) found[i] = found[i + 1] * shape[i + 1];
  return found;
}

export class Cells {
  /**
   * @param {{name: string, size: number}[]} dims of the cube's cells
   * @param {{name: string, values: number[]}[]} axes swept parameters, or what all cells share
   */
  constructor(dims, axes) {
    this.dims = dims;
    this.axes = axes;
    this.strides = strides(dims.map((dim) => dim.size));
    this.count = dims.reduce((product, dim) => product * dim.size, 1);
  }

  /** Index on every dim of a cell. */
  place(cell) {
    const found = {};
    this.dims.forEach((dim, i) => { found[dim.name] = Math.floor(cell / this.strides[i]) % dim.size; });
    return found;
  }

  /** Index on every axis of a cell; 0 on one that is no dim. */
  at(cell) {
    const place = this.place(cell);
    return Object.fromEntries(this.axes.map((axis) => [axis.name, place[axis.name] ?? 0]));
  }

  /**
   * The cells of a diagram.
   * @param {string} x name of the horizontal axis
   * @param {Object<string, number>} at index on each other axis
   * @param {number[]|null} window range of x that is looked at; null for all of it
   * @returns {{x: Float64Array, cell: Uint32Array, at: Uint32Array, ranges: number[][], covers: number[]|null}}
   *   `ranges` are first and last index plus one on every dim, of what holds the cells
   */
  select(x, at, window = null) {
    const axis = this.axes.find((one) => one.name === x);
    const order = axis.values.map((_, i) => i).sort((a, b) => axis.values[a] - axis.values[b]);
    const values = Float64Array.from(order, (i) => axis.values[i]);
    let [low, high] = [0, order.length];
    if (window) {
      while (low < high - 1 && values[low + 1] <= window[0]) low++;
      while (high > low + 1 && values[high - 2] >= window[1]) high--;
    }
    const shown = order.slice(low, high), lead = this.dims.findIndex((dim) => dim.name === x);
    const ranges = this.dims.map((dim, i) => {
      if (i === lead) return [Math.min(...shown), Math.max(...shown) + 1];
      const one = this.axes.some((other) => other.name === dim.name) ? at?.[dim.name] ?? 0 : null;
      return one === null ? [0, dim.size] : [one, one + 1];
    });
    const rest = this.others(ranges, lead);
    const cell = new Uint32Array(shown.length * rest.length), places = new Uint32Array(cell.length);
    shown.forEach((index, i) => {
      const begin = lead < 0 ? 0 : index * this.strides[lead];
      for (let k = 0; k < rest.length; k++) {
        cell[i * rest.length + k] = begin + rest[k];
        places[i * rest.length + k] = low + i;
      }
    });
    const whole = low === 0 && high === order.length;
    return { x: values, cell, at: places, ranges, covers: whole ? null : [values[low], values[high - 1]] };
  }

  /** Numbers of the cells at the first value of one dim, within ranges of the others. */
  others(ranges, lead) {
    let found = [0];
    ranges.forEach(([first, end], i) => {
      if (i === lead) return;
      const next = [];
      for (const begin of found) for (let k = first; k < end; k++) next.push(begin + k * this.strides[i]);
      found = next;
    });
    return found;
  }
}
