// How far this computer's clock is from the server's, so that the latency of a frame is known on any computer.
// Of a few questions, the one that was answered fastest counts: the server's clock was read half of that time ago.

const QUESTIONS = 8;
let best = null;
let left = 0;

export function compareClocks(send) {
  best = null;
  left = QUESTIONS;
  send({ clock: Date.now() });
}

export function tellClock({ clock, server }, send) {
  const now = Date.now();
  if (best === null || now - clock < best.trip) best = { trip: now - clock, offset: 1000 * server - (now + clock) / 2 };
  left -= 1;
  if (left > 0) send({ clock: Date.now() });
}

// Milliseconds to add to this computer's clock; null if it is not known yet.
export const clockOffset = () => (best === null ? null : best.offset);
