// What is asked of the points, in the worker or, where a page may have none, beside it.

import { Drawing } from "./drawing.js";

const ANSWERS = {
  load: (held, { data }) => {
    held.drawing = new Drawing(data);
    return { result: { extent: held.drawing.extent(), count: data.y.length } };
  },
  colours: (held, { bytes }) => ({ result: held.drawing.setColours(bytes) }),
  render: async (held, { bounds, width, height, scale, most }) => {
    const { pixels, count, part } = held.drawing.render(bounds, width, height, scale, most ?? Infinity);
    const bitmap = await createImageBitmap(new ImageData(pixels, width, height));
    return { result: { bitmap, bounds, count, part }, transfer: [bitmap] };
  },
  nearest: (held, { bounds, width, height, x, y, reach }) => ({
    result: held.drawing.nearest(bounds, width, height, x, y, reach),
  }),
  locate: (held, { index, point }) => ({ result: held.drawing.locate(index, point) }),
  step: (held, { from, direction, resolution }) => ({ result: held.drawing.step(from, direction, resolution) }),
  points: (held, { bounds, most }) => {
    const result = held.drawing.points(bounds, most);
    return { result, transfer: result ? [result.buffer] : [] };
  },
};

/** Answer one question; `held` is what is kept between them. */
export async function answer(held, what, args) {
  return ANSWERS[what](held, args);
}
