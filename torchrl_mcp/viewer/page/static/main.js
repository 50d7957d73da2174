// The page: shows the simulation in real time, and handles keys, pointer and buttons.

import { Drawing } from "./drawing.js";
import { open } from "./simulation.js";

const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7f7f7f", "#b8860b"];
const SPEEDS = [1, 0.5, 0.2]; // relative to real time
const PUSH_SECONDS = 0.15;
const PUSH_SPEED = 0.5; // m/s that a push adds to the velocity of the whole body
const SLACK = 6; // pixels that the pointer may move during a click
const DEBT = 0.1; // longest time of computation per picture, in seconds
const FALLEN_SECONDS = 2; // from a fall to the next episode
const LEAST_PICTURES = 20; // pictures per second below which, after a second, the drawing becomes simpler

const element = (id) => document.getElementById(id);

class Page {
  owed = 0; // seconds of simulation that are due
  pace = 0; // index of SPEEDS
  paused = false;
  pushed = 0; // remaining seconds of a push
  lying = 0; // seconds since a fall
  few = 0; // number of successive half seconds with too few pictures
  pictures = { since: performance.now(), count: 0, simulated: 0, wanted: 0 };

  constructor(simulation) {
    Object.assign(this, { simulation, drawing: new Drawing(element("view")) });
    this.drawing.show(simulation.scene);
    this.addGates();
    this.addButtons();
    this.addPointer();
    addEventListener("keydown", (event) => this.press(event));
    // Time in a hidden tab does not count as due.
    document.addEventListener("visibilitychange", () => (this.last = performance.now()));
    new ResizeObserver(([{ contentRect }]) => {
      this.drawing.resize(Math.max(contentRect.width, 1), Math.max(contentRect.height, 1));
    }).observe(element("stage"));
    this.last = performance.now();
    requestAnimationFrame((now) => this.frame(now));
  }

  get task() {
    return this.simulation.scene.task;
  }

  /** Simulate the time since the last picture, draw, and request the next picture; in a hidden tab, do not simulate. */
  async frame(now) {
    const seconds = Math.min(Math.max(now - this.last, 0) / 1000, 1); // `now` may lie before the last event
    this.last = now;
    if (!this.paused && !document.hidden) await this.simulate(seconds);
    this.drawing.draw(this.task.arrows(), seconds);
    this.showWeights();
    this.count(now);
    requestAnimationFrame((next) => this.frame(next));
  }

  async simulate(seconds) {
    const { physics_timestep } = this.simulation.description;
    const limit = performance.now() + 1000 * DEBT;
    this.owed += seconds * SPEEDS[this.pace];
    this.pictures.wanted += seconds;
    while (this.owed >= physics_timestep && performance.now() < limit) {
      await this.simulation.advance();
      this.owed -= physics_timestep;
      this.pictures.simulated += physics_timestep;
      this.pushed -= physics_timestep;
      if (this.pushed <= 0) this.simulation.push(0, 0);
      this.lying = this.simulation.fallen ? this.lying + physics_timestep : 0;
    }
    if (this.owed >= physics_timestep) this.owed = 0; // on slow devices drop the rest, which the status line reports
    if (this.lying > FALLEN_SECONDS) this.reset();
  }

  /** Twice a second, show the frames per second, and whether the simulation keeps real time. */
  count(now) {
    const { pictures } = this;
    pictures.count += 1;
    const seconds = (now - pictures.since) / 1000;
    if (seconds < 0.5) return;
    const pace = pictures.wanted ? pictures.simulated / pictures.wanted : 0;
    const slow = pace < 0.93 * SPEEDS[this.pace];
    const time = this.paused ? "paused" : pace > 0.93 ? "real time" : `${pace.toFixed(2)} × real time`;
    const reason = !this.paused && slow ? ": this device is too slow" : "";
    const fall = this.simulation.fallen ? " · fallen, restarts soon" : "";
    element("status").textContent = `${Math.round(pictures.count / seconds)} frames/s · ${time}${reason}${fall}`;
    this.few = pictures.count / seconds < LEAST_PICTURES ? this.few + 1 : 0;
    if (this.few === 2) this.drawing.lighten();
    this.pictures = { since: now, count: 0, simulated: 0, wanted: 0 };
  }

  addGates() {
    const { gates } = this.simulation.description;
    element("gates").hidden = gates.length < 2;
    gates.forEach(({ name }, index) => {
      const button = Object.assign(document.createElement("button"), { textContent: name });
      button.onclick = () => this.select(index);
      element("gates").append(button);
    });
    this.select(0);
  }

  select(index) {
    if (this.simulation.scene !== this.simulation.scenes[index]) {
      this.simulation.select(index);
      this.drawing.show(this.simulation.scene);
    }
    [...element("gates").children].forEach((button, number) => button.setAttribute("aria-pressed", number === index));
    element("pad").hidden = !this.task.steers;
    for (const id of ["faster", "slower", "stop"]) element(id).hidden = !this.task.paces;
    element("help").textContent = HELP[this.simulation.scene.gate.task];
  }

  /** Show a bar for each primitive; the bars are added after the first step, which gives the number of primitives. */
  showWeights() {
    const { weights, pinned } = this.simulation;
    const bars = element("bars").children;
    while (bars.length < weights.length) this.addBar(bars.length);
    weights.forEach((weight, primitive) => {
      const input = bars[primitive].querySelector("input");
      if (!pinned.has(primitive)) input.value = weight;
      bars[primitive].style.setProperty("--weight", `${100 * input.value}%`);
      bars[primitive].classList.toggle("pinned", pinned.has(primitive));
    });
    element("release").disabled = pinned.size === 0;
  }

  addBar(primitive) {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 1, step: 0.01 });
    input.setAttribute("aria-label", `weight of primitive ${primitive + 1}`);
    input.oninput = () => this.simulation.pinned.set(primitive, Number(input.value));
    input.onpointerdown = input.oninput;
    label.style.setProperty("--colour", COLOURS[primitive % COLOURS.length]);
    label.append(`${primitive + 1}`, input);
    element("bars").append(label);
  }

  addButtons() {
    const actions = {
      left: () => this.task.turn(1),
      right: () => this.task.turn(-1),
      faster: () => this.task.walk(1),
      slower: () => this.task.walk(-1),
      stop: () => this.task.stop(),
      push: () => this.push(),
      reset: () => this.reset(),
      slow: () => this.slow(1),
      pause: () => this.pause(),
      release: () => this.simulation.pinned.clear(),
    };
    for (const [id, action] of Object.entries(actions)) {
      element(id).addEventListener("click", ({ detail, currentTarget }) => {
        action();
        if (detail) currentTarget.blur(); // after a click, keys steer the character again
      });
    }
    this.keys = {
      ArrowLeft: actions.left,
      ArrowRight: actions.right,
      ArrowUp: actions.faster,
      ArrowDown: actions.slower,
      " ": () => (this.task.paces ? actions.stop() : actions.pause()),
      Enter: actions.release,
      Backspace: actions.reset,
      "-": () => this.slow(1),
      "=": () => this.slow(-1),
      p: actions.push,
    };
  }

  press(event) {
    const { target, key } = event;
    const typing = target.matches("input") || (target.matches("a, button") && (key === " " || key === "Enter"));
    if (typing || event.ctrlKey || event.altKey || event.metaKey || !this.keys[key]) return;
    event.preventDefault();
    this.keys[key]();
  }

  /** A click on the ground chooses a place; a click on the character pushes it away. */
  addPointer() {
    const view = element("view");
    let pressed = null;
    view.addEventListener("pointerdown", ({ clientX, clientY }) => (pressed = [clientX, clientY]));
    view.addEventListener("pointerup", ({ clientX, clientY }) => {
      if (!pressed || Math.hypot(clientX - pressed[0], clientY - pressed[1]) > SLACK) return;
      const { left, top, width, height } = view.getBoundingClientRect();
      const hit = this.drawing.pick((2 * (clientX - left)) / width - 1, 1 - (2 * (clientY - top)) / height);
      if (hit?.isCharacter) this.push();
      else if (hit) this.task.put(hit.place);
    });
  }

  /** Push the character in the direction in which the camera looks. */
  push() {
    const { model } = this.simulation.scene;
    const force = (model.body_subtreemass[1] * PUSH_SPEED) / PUSH_SECONDS;
    this.simulation.push(...this.drawing.ahead().map((axis) => force * axis));
    this.pushed = PUSH_SECONDS;
  }

  reset() {
    this.lying = 0;
    this.simulation.reset();
  }

  slow(step) {
    const index = this.pace + step;
    this.pace = step > 0 ? index % SPEEDS.length : Math.max(index, 0);
    element("slow").setAttribute("aria-pressed", this.pace > 0);
    element("slow").textContent = this.pace ? `${SPEEDS[this.pace]} × speed` : "slow motion";
  }

  pause() {
    this.paused = !this.paused;
    element("pause").setAttribute("aria-pressed", this.paused);
  }
}

const HELP = {
  Heading: "Click the ground, or press ← and →, to turn the character. ↑ and ↓ change the speed, if it can be changed.",
  Location: "Click the ground to send the character there, or steer it with ← → ↑ ↓. Space stops the character.",
  Carry: "Click the ground to move the red table there. The character then brings the box.",
  Dribble: "Click the ground to move the target there. The character then brings the ball.",
  Imitation: "The character imitates a motion; the arrow shows where the motion is. The buttons choose another motion.",
};

const simulation = await open();
const { title, command } = simulation.description;
document.title = title;
element("title").textContent = title;
element("command").textContent = command;
window.page = new Page(simulation);
document.body.classList.add("ready");
