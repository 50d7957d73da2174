// Tasks with their memory and steering, for one simulation, as in envs/tasks and viewer/steering.py.

import {
  apart, carry_waypoint, character_state, dribble_waypoint, goal_of, heading, logarithmic, mismatch, place_ahead,
  place_seen, quaternion, reference_state, steps, turned, vector, walkable, way,
} from "./observations.js";

const TURN = Math.PI / 12; // radians by which a key turns the target
const SPEED_STEP = 0.25; // m/s by which a key changes the speed
const DAMPING = -Math.log(1 - 0.4); // of the ball, dribble.py
const [HALF_SIZE, TOP_HALF_SIZE, CLEARANCE, RESTING_GAP] = [0.15, 0.14, 0.1, 0.01]; // metres, tables.py and carry.py
const AHEAD = 60; // least number of steps from the beginning of an episode to the end of its clip

const between = (low, high) => low + (high - low) * Math.random();

class Task {
  steers = false; // whether arrow keys turn the target

  constructor({ mujoco, model, data, gate }) {
    Object.assign(this, { mujoco, model, data, gate });
  }

  get com() {
    return vector(this.data.subtree_com, 1);
  }

  get heading() {
    return heading(quaternion(this.data.xquat, 1));
  }

  /** Whether the speed of the target can be changed. */
  get paces() {
    return this.steers && this.gate.speeds[0] < this.gate.speeds[1];
  }

  /** A place at a distance, in a direction from the character's heading. */
  ahead(distance, direction, [x, y] = this.com) {
    const [dx, dy] = steps(distance, this.heading + direction);
    return [x + dx, y + dy];
  }

  start() {} // sets the state in which an episode begins
  after_step() {}
  put() {}
  turn() {}
  walk() {}
  stop() {}
}

class Steered extends Task {
  steers = true;

  walk(sign) {
    const [low, high] = this.gate.speeds;
    this.lead(this.direction, Math.min(Math.max(this.speed + sign * SPEED_STEP, low), high));
  }

  turn(sign) {
    this.lead(this.direction + sign * TURN, this.speed);
  }

  stop() {
    this.lead(this.direction, this.gate.speeds[0]);
  }

  lead(direction, speed) {
    Object.assign(this, { direction, speed });
  }

  velocity() {
    return steps(this.speed, this.direction);
  }
}

export class Heading extends Steered {
  begin() {
    const [low, high] = this.gate.speeds;
    this.lead(this.heading, Math.min(Math.max(1, low), high));
  }

  put(place) {
    this.lead(Math.atan2(place[1] - this.com[1], place[0] - this.com[0]), this.speed || this.gate.speeds[1]);
  }

  goal() {
    const goal = steps(1, this.direction - this.heading);
    if (this.gate.goal.includes("speed")) goal.push(this.speed);
    return this.gate.waypoint ? [...goal, ...place_seen(this.data, place_ahead(this.com, this.velocity()))] : goal;
  }

  arrows() {
    const tail = [this.com[0], this.com[1], this.com[2] + 0.9 * this.model.qpos0[2]];
    const [x, y] = this.velocity();
    return [[tail, [tail[0] + x, tail[1] + y, tail[2]]]];
  }
}

export class Location extends Steered {
  begin() {
    this.put(this.ahead(between(2.5, 4), between(-1, 1)));
  }

  put(place) {
    this.target = place.slice(0, 2);
    this.leads = false;
    this.speed = this.gate.speeds[1];
    this.final_direction = Math.atan2(place[1] - this.com[1], place[0] - this.com[0]);
    this.direction = this.final_direction;
  }

  lead(direction, speed) {
    super.lead(direction, speed);
    this.leads = speed > 0; // at a speed of 0, the character stands where it is
    this.target = this.com.slice(0, 2);
    this.final_direction = direction;
  }

  goal() {
    if (this.leads) this.target = place_ahead(this.com, this.velocity());
    const seen = logarithmic(walkable(way(this.data, this.target)));
    return this.gate.goal.includes("final_direction") ? [...seen, ...steps(1, this.final_direction - this.heading)] : seen;
  }

  arrived() {
    return apart(this.com, this.target) < 0.3;
  }

  arrows() {
    const [x, y] = this.target;
    return [[[x, y, 1], [x, y, 0]]];
  }
}

class Transport extends Task {
  constructor(scene) {
    super(scene);
    const { mjOBJ_BODY } = this.mujoco.mjtObj;
    this.body = (name) => this.mujoco.mj_name2id(this.model, mjOBJ_BODY.value, name);
    this.mocap = (name) => this.model.body_mocapid[this.body(name)];
    this.sizes = this.gate.objects.map(([name, size]) => [this.body(name), size]);
    this.object = this.body(this.gate.objects.at(-1)[0]);
  }

  goal() {
    return goal_of(this.model, this.data, this.sizes, this.gate.logarithmic, this.gate.waypoint && this.waypoint());
  }

  place(name) {
    return vector(this.data.xpos, this.body(name));
  }

  /** Move an object without joints. */
  move(name, [x, y]) {
    this.data.mocap_pos.set([x, y], 3 * this.mocap(name));
  }

  put(place) {
    this.move("target", place);
  }

  arrows() {
    const [com, object, target] = [this.com, vector(this.data.xpos, this.object), this.place("target")];
    return [pointer(com, object), pointer(object, target)];
  }
}

/** A horizontal arrow above `tail`, towards `tip` and at most 1 m long. */
function pointer(tail, tip) {
  const scale = 1 / Math.max(apart(tail, tip), 1);
  const [x, y, z] = [tail[0], tail[1], tail[2] + 0.8];
  return [[x, y, z], [x + scale * (tip[0] - tail[0]), y + scale * (tip[1] - tail[1]), z]];
}

export class Dribble extends Transport {
  begin() {
    const ball = this.ahead(between(1.8, 2.5), between(-0.4, 0.4));
    this.data.qpos.set(ball, this.model.nq - 7);
    this.put(this.ahead(between(3, 4), between(-0.6, 0.6), ball));
  }

  waypoint() {
    const [ball, [vx, vy]] = [this.place("ball"), this.data.qvel.subarray(this.model.nv - 6)];
    return dribble_waypoint(this.com, ball, [ball[0] + vx / DAMPING, ball[1] + vy / DAMPING], this.place("target"));
  }
}

export class Carry extends Transport {
  constructor(scene) {
    super(scene);
    const { mjOBJ_EQUALITY, mjOBJ_GEOM } = this.mujoco.mjtObj;
    this.joint = this.mujoco.mj_name2id(this.model, mjOBJ_EQUALITY.value, "box_joint");
    this.box = this.mujoco.mj_name2id(this.model, mjOBJ_GEOM.value, "box");
    this.carrier = this.body(this.gate.carrier);
    this.source_height = this.model.body_pos[3 * this.body("source") + 2];
  }

  begin() {
    const box = this.ahead(between(2, 3), between(-0.7, 0.7));
    this.offer(box, between(-1, 1));
    this.put(this.ahead(between(2, 3), between(-0.8, 0.8), box));
  }

  /** Move the source to a place, and lay the box on it, so that the character can take the box. */
  offer([x, y], angle) {
    const turn = [Math.cos(angle / 2), 0, 0, Math.sin(angle / 2)];
    this.data.mocap_pos.set([x, y, this.source_height], 3 * this.mocap("source"));
    this.data.mocap_quat.set(turn, 4 * this.mocap("source"));
    this.data.qpos.set([x, y, this.source_height + HALF_SIZE, ...turn], this.model.nq - 7);
    this.data.qvel.fill(0, this.model.nv - 6);
    this.fix(false);
    this.taken = false;
  }

  /** Fix the box to the carrier, or release it. JavaScript cannot write eq_active directly. */
  fix(held) {
    const { mujoco, model, data } = this;
    const part = mujoco.mjtState.mjSTATE_EQ_ACTIVE.value;
    const active = new mujoco.DoubleBuffer(model.neq);
    mujoco.mj_getState(model, data, active, part);
    active.GetView()[this.joint] = Number(held);
    mujoco.mj_setState(model, data, Array.from(active.GetView()), part);
    active.delete();
    this.held = held;
  }

  /** Set the target; a box that was put down is first lifted onto the source where it lies, so that it is taken again. */
  put(place) {
    if (this.taken && !this.held) this.offer(this.place("box"), heading(quaternion(this.data.xquat, this.object)));
    super.put(place);
  }

  waypoint() {
    return carry_waypoint(this.com, this.place("box"), this.place("target"), this.taken, this.held);
  }

  /** The carrier takes a box on the source by touching it, and releases it over the target, as in Carry.after_step. */
  after_step() {
    const touching = !this.taken && this.data.sensordata.some((gap) => gap <= 0);
    if (this.held && this.over("target", CLEARANCE + RESTING_GAP)) {
      this.fix(false);
    } else if (touching && this.over("source", RESTING_GAP)) {
      this.model.eq_data.set(this.relative_pose(), 11 * this.joint + 3);
      this.fix(true);
      this.data.mocap_pos[3 * this.mocap("source") + 2] -= CLEARANCE;
      this.taken = true;
    }
  }

  /** Whether the centre of the box is over a table, and its lowest point less than `gap` above the top. */
  over(table, gap) {
    const body = this.body(table);
    const offset = this.place("box").map((value, axis) => value - this.data.xpos[3 * body + axis]);
    const [x, y, z] = columns(this.data.xmat, body).map((column) => dot(column, offset));
    const vertical = [6, 7, 8].reduce((sum, index) => sum + Math.abs(this.data.geom_xmat[9 * this.box + index]), 0);
    const inside = Math.abs(x) < TOP_HALF_SIZE && Math.abs(y) < TOP_HALF_SIZE;
    return inside && z > 0 && z - HALF_SIZE * vertical < gap;
  }

  /** Position and orientation of the box in the carrier's frame. */
  relative_pose() {
    const offset = this.place("box").map((value, axis) => value - this.data.xpos[3 * this.carrier + axis]);
    const place = columns(this.data.xmat, this.carrier).map((column) => dot(column, offset));
    const [w, x, y, z] = quaternion(this.data.xquat, this.carrier);
    const [a, b, c, d] = quaternion(this.data.xquat, this.object);
    const turn = [
      w * a + x * b + y * c + z * d,
      w * b - x * a - y * d + z * c,
      w * c + x * d - y * a - z * b,
      w * d - x * c + y * b - z * a,
    ];
    return [...place, ...turn];
  }
}

/** Axes of a body in the world. */
const columns = (matrices, body) => [0, 1, 2].map((axis) => [0, 3, 6].map((row) => matrices[9 * body + row + axis]));

const dot = (a, b) => a.reduce((sum, value, index) => sum + value * b[index], 0);

export class Imitation extends Task {
  constructor(scene) {
    super(scene);
    const { num_bodies, rows } = scene.gate.clip;
    const body = (index) => Array.from(rows.subarray(13 * index, 13 * index + 13));
    this.frames = Array.from({ length: rows.length / (13 * num_bodies) }, (_, frame) => {
      return Array.from({ length: num_bodies }, (_, index) => body(frame * num_bodies + index));
    });
  }

  get place() {
    return vector(this.data.xpos, 1);
  }

  start() {
    const { qpos, qvel } = this.gate.clip;
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
  }

  /** Begin at the frame of the clip that is most similar to the character's state, moved to its place and heading. */
  begin() {
    const state = character_state(this.model, this.data, this.gate.clip.num_bodies).slice(1);
    const mismatches = this.frames.slice(0, Math.max(this.frames.length - AHEAD, 1)).map((bodies) => {
      const [root] = bodies;
      return mismatch(state, reference_state(heading(root.slice(3, 7)), root.slice(0, 3), bodies));
    });
    this.frame = mismatches.indexOf(Math.min(...mismatches));
    const [root] = this.frames[this.frame];
    this.angle = this.heading - heading(root.slice(3, 7));
    const [x, y] = turned(root, -this.angle);
    this.shift = [this.place[0] - x, this.place[1] - y];
  }

  /** A place of the scene in the coordinates of the clip. */
  inverse([x, y]) {
    return [...turned([x - this.shift[0], y - this.shift[1]], this.angle), 0];
  }

  goal() {
    const origin = this.inverse(this.place);
    const bodies = [this.frames[this.frame + 1], this.frames[this.frame + 2]];
    return bodies.flatMap((each) => reference_state(this.heading - this.angle, origin, each));
  }

  after_step() {
    this.frame += 1;
    if (this.frame + 3 > this.frames.length) this.begin();
  }

  arrows() {
    const [root] = this.frames[this.frame];
    const [x, y] = turned(root, -this.angle).map((value, axis) => value + this.shift[axis]);
    return [[[x, y, 2 * root[2]], [x, y, 1.4 * root[2]]]];
  }
}

export const TASKS = { Heading, Location, Carry, Dribble, Imitation };
