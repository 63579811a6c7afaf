// What the page shows, in one place: who changes it sets a part of it, who shows it listens to names.

/** Whether two values of a state are the same; all are what JSON can say. */
function same(a, b) {
  return a === b || JSON.stringify(a) === JSON.stringify(b);
}

/**
 * Make a state.
 * @param {Object} initial values by name
 * @returns {{get: function(): Object, set: function(Object): void, on: function(string[], function): function}}
 *   `set` takes some of the values and calls the listeners of those that changed, once; `on` gives what ends it
 */
export function createState(initial) {
  let values = Object.freeze({ ...initial });
  const listeners = new Set();
  return {
    get: () => values,
    set(patch) {
      const changed = Object.keys(patch).filter((key) => !same(values[key], patch[key]));
      if (!changed.length) return;
      values = Object.freeze({ ...values, ...patch });
      for (const listener of [...listeners]) {
        if (changed.some((key) => listener.keys.has(key))) listener.call(values, changed);
      }
    },
    on(keys, call) {
      const listener = { keys: new Set(keys), call };
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
  };
}
