// Observations of a policy in one simulation, with the names of observations.py and of the goals in envs/tasks.
// Positions are in metres and angles in radians; quaternions are (w, x, y, z).

export const LINEAR_DISTANCE = 0.25; // places.py
export const ARRIVAL_DISTANCE = 0.3; // rewards.py
const WALK_AHEAD = 1.5; // seconds; this line and the next are the constants of waypoints.py
const [STRIDE, PUSH, SHARE, BEHIND, ASIDE, STEP] = [1.0, 0.5, 0.1, 0.7, Math.PI / 4, 0.5];
const [SUCCESS_DISTANCE, SUCCESS_REACH] = [0.5, 2.0]; // rewards.py
const HORIZON = 0.25; // seconds, imitation_reward.py

/** Horizontal angle between the x axes of a body and of the world. */
export const heading = ([w, x, y, z]) => Math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z));

/** The `index`-th vector of an array of vectors with three components. */
export const vector = (array, index) => [array[3 * index], array[3 * index + 1], array[3 * index + 2]];

export const quaternion = (array, index) => Array.from(array.subarray(4 * index, 4 * index + 4));

/** A vector in a frame that is turned by an angle. */
export const turned = ([x, y], angle) => {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return [x * cos + y * sin, y * cos - x * sin];
};

/** Position, orientation, linear and angular velocity in the frame of an origin and a heading: 13 numbers. */
export function in_heading_frame(angle, origin, place, [w, i, j, k], velocity, spin) {
  const [qw, qz] = turned([w, k], angle / 2);
  const [qx, qy] = turned([i, j], angle / 2);
  const sign = qw < 0 || Object.is(qw, -0) ? -1 : 1;
  const seen = (values) => [...turned(values, angle), values[2]];
  const offset = place.map((value, axis) => value - origin[axis]);
  return [...seen(offset), sign * qw, sign * qx, sign * qy, sign * qz, ...seen(velocity), ...seen(spin)];
}

/** The same 13 numbers for a body of the scene. */
export function body_in_heading_frame(angle, origin, model, data, body) {
  const [vx, vy, vz] = [3, 4, 5].map((axis) => data.cvel[6 * body + axis]);
  const spin = [0, 1, 2].map((axis) => data.cvel[6 * body + axis]);
  const place = vector(data.xpos, body);
  const centre = vector(data.subtree_com, model.body_rootid[body]);
  const [x, y, z] = place.map((value, axis) => value - centre[axis]);
  const [a, b, c] = spin; // v = v_c + spin x (place - centre)
  const velocity = [vx + b * z - c * y, vy + c * x - a * z, vz + a * y - b * x];
  return in_heading_frame(angle, origin, place, quaternion(data.xquat, body), velocity, spin);
}

/** State of a character whose bodies are the first of the scene: the height of the root, and 13 numbers per body. */
export function character_state(model, data, num_bodies) {
  const [angle, root] = [heading(quaternion(data.xquat, 1)), vector(data.xpos, 1)];
  const bodies = Array.from({ length: num_bodies }, (_, index) => index + 1);
  return [root[2], ...bodies.flatMap((body) => body_in_heading_frame(angle, root, model, data, body))];
}

/** The bodies of a frame of a clip, one row of 13 numbers each, in the frame of an origin and a heading. */
export function reference_state(angle, origin, bodies) {
  return bodies.flatMap((row) => {
    return in_heading_frame(angle, origin, row.slice(0, 3), row.slice(3, 7), row.slice(7, 10), row.slice(10));
  });
}

/** Mismatch of two states, as in imitation_reward.py: squared differences of positions, and weighted ones of velocities. */
export function mismatch(state, reference) {
  const differences = state.map((value, index) => (value - reference[index]) ** 2);
  const weights = [1, 1, 1, 0, 0, 0, 0, HORIZON ** 2, HORIZON ** 2, HORIZON ** 2, 0, 0, 0];
  return differences.reduce((sum, value, index) => sum + weights[index % 13] * value, 0);
}

/** A position in the same direction, at a logarithmic distance. */
export function logarithmic([x, y]) {
  const distance = Math.hypot(x, y);
  const factor = distance > 0 ? Math.log1p(distance / LINEAR_DISTANCE) / distance : 0;
  return [factor * x, factor * y];
}

/** A place relative to the centre of mass, in the heading frame of the character. */
export const way = (data, [x, y]) =>
  turned([x - data.subtree_com[3], y - data.subtree_com[4]], heading(quaternion(data.xquat, 1)));

export const place_seen = (data, place) => logarithmic(way(data, place));

export const place_ahead = ([x, y], [vx, vy]) => [x + WALK_AHEAD * vx, y + WALK_AHEAD * vy];

/** Replace places far to the side, which a character could face only by turning on the spot. */
export function walkable([x, y]) {
  const [angle, distance] = [Math.atan2(y, x), Math.hypot(x, y)];
  if (Math.abs(angle) <= ASIDE) return [x, y];
  if (distance > STEP) return steps(STEP, ASIDE * Math.sign(angle));
  return distance < ARRIVAL_DISTANCE ? [0, 0] : [x, y];
}

export const steps = (distance, direction) => [distance * Math.cos(direction), distance * Math.sin(direction)];

export const apart = ([x, y], [u, v]) => Math.hypot(x - u, y - v);

const normalized = ([x, y]) => [x, y].map((value) => value / Math.max(Math.hypot(x, y), 1e-12));

/** The goal of a task with objects: the first `size` numbers of each body, and the waypoint if there is one. */
export function goal_of(model, data, sizes, is_logarithmic, waypoint) {
  const [angle, root] = [heading(quaternion(data.xquat, 1)), vector(data.xpos, 1)];
  const seen = sizes.flatMap(([body, size]) => {
    const [x, y, ...rest] = body_in_heading_frame(angle, root, model, data, body);
    return [...(is_logarithmic ? logarithmic([x, y]) : [x, y]), ...rest].slice(0, size);
  });
  return waypoint ? [...seen, ...place_seen(data, waypoint)] : seen;
}

/** The box, then a place on the way that brings the carried box to the target, then the place of the character. */
export function carry_waypoint(com, box, target, taken, held) {
  if (!held) return taken ? com : box;
  const [x, y] = normalized([target[0] - box[0], target[1] - box[1]]);
  const length = Math.min(apart(target, box) + ARRIVAL_DISTANCE, STRIDE);
  return [com[0] + length * x, com[1] + length * y];
}

/** Places around the ball until the character is behind it, then a place beyond the ball, then the character's place. */
export function dribble_waypoint(com, ball, rest, target) {
  if (apart(rest, target) < SUCCESS_DISTANCE) return apart(com, ball) < SUCCESS_REACH ? com : ball;
  const meeting = [(ball[0] + rest[0]) / 2, (ball[1] + rest[1]) / 2];
  const approach = normalized([meeting[0] - com[0], meeting[1] - com[1]]);
  const onward = normalized([target[0] - meeting[0], target[1] - meeting[1]]);
  const left = [-onward[1], onward[0]];
  const alignment = approach[0] * onward[0] + approach[1] * onward[1];
  const side = alignment < 0 ? -Math.sign(approach[0] * left[0] + approach[1] * left[1]) : 0;
  const beyond = Math.min(SHARE * apart(target, meeting), PUSH);
  const offset = (axis) => (alignment > BEHIND ? beyond * onward[axis] : PUSH * (side * left[axis] - onward[axis]));
  return [meeting[0] + offset(0), meeting[1] + offset(1)];
}
