// The worker that has the points: draws windows of them and finds points in them.

import { answer } from "./drawing-answers.js";

const held = {};
let waiting = null;

// a picture that a newer question has overtaken is not drawn
function draw() {
  const { id, args } = waiting;
  waiting = null;
  reply(id, "render", args);
}

function reply(id, what, args) {
  answer(held, what, args).then(
    ({ result, transfer = [] }) => postMessage({ id, result }, transfer),
    (error) => postMessage({ id, error: String(error?.message ?? error) }),
  );
}

onmessage = ({ data: { id, what, args } }) => {
  if (what !== "render" || args.keep) return reply(id, what, args);
  if (waiting) postMessage({ id: waiting.id, result: null });
  else setTimeout(draw);
  waiting = { id, args };
};
