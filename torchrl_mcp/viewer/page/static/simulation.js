// Runs MuJoCo and the networks in the browser, for one character and several gates over its primitives.

import loadMujoco from "./runtimes/mujoco.js";
import * as ort from "./runtimes/ort.js";
import { character_state } from "./observations.js";
import { TASKS } from "./tasks.js";

const fetched = async (name) => {
  const response = await fetch(new URL(name, import.meta.url));
  if (!response.ok) throw new Error(`${name} is missing (${response.status}): copy the whole folder`);
  return response;
};

/** Content of a compressed file, even if the server has already decompressed it. */
async function unpacked(name) {
  const packed = new Uint8Array(await (await fetched(name)).arrayBuffer());
  if (packed[0] !== 0x1f || packed[1] !== 0x8b) return packed.buffer;
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/** Fetch everything, and return the simulation at the beginning of an episode. */
export async function open() {
  const description = await (await fetched("page.json")).json();
  const [wasmBinary, networks] = await Promise.all(["runtimes/mujoco.wasm.gz", "runtimes/ort.wasm.gz"].map(unpacked));
  Object.assign(ort.env.wasm, { wasmBinary: networks, numThreads: 1 });
  const session = async (name) => ort.InferenceSession.create(await (await fetched(name)).arrayBuffer());
  const mujoco = await loadMujoco({ wasmBinary });
  const [primitives, mixer] = [await session("primitives.onnx"), await session("mixer.onnx")];
  const scenes = [];
  const compiled = async (name) => {
    const model = mujoco.MjModel.from_xml_string(await (await fetched(name)).text());
    model.opt.timestep = description.physics_timestep;
    return { model, data: new mujoco.MjData(model) };
  };
  const loaded = new Map(); // clips share a scene and a network
  const once = async (make, name) => loaded.get(name) ?? loaded.set(name, await make(name)).get(name);
  for (const gate of description.gates) {
    if (gate.clip) gate.clip.rows = new Float32Array(await (await fetched(gate.clip.file)).arrayBuffer());
    const scene = { mujoco, gate, network: await once(session, gate.network), ...(await once(compiled, gate.scene)) };
    scenes.push({ ...scene, task: new TASKS[gate.task](scene) });
  }
  return new Simulation(description, scenes, primitives, mixer);
}

export class Simulation {
  scene = null;
  weights = []; // weights of the primitives in the last step
  pinned = new Map(); // weights that the reader has fixed, by primitive
  substep = 0;

  constructor(description, scenes, primitives, mixer) {
    Object.assign(this, { description, scenes, primitives, mixer, mujoco: scenes[0].mujoco });
    this.scene = scenes[0];
    this.reset();
  }

  get time() {
    return this.scene.data.time;
  }

  /** Begin an episode, in which the character stands at the origin. */
  reset() {
    const { model, data, task } = this.scene;
    this.mujoco.mj_resetData(model, data);
    task.start();
    this.mujoco.mj_forward(model, data);
    task.begin();
    this.refresh();
    this.substep = 0;
  }

  /** Continue with another gate: the character keeps its state in the scene of that gate. */
  select(index) {
    const { num_qpos, num_qvel } = this.description;
    const qpos = this.scene.data.qpos.slice(0, num_qpos);
    const qvel = this.scene.data.qvel.slice(0, num_qvel);
    this.scene = this.scenes[index];
    this.reset();
    const { model, data, task } = this.scene;
    data.qpos.set(qpos);
    data.qvel.set(qvel);
    this.mujoco.mj_forward(model, data);
    task.begin();
    this.refresh();
  }

  /** Update the observed quantities after a change of the state. */
  refresh() {
    this.mujoco.mj_fwdPosition(this.scene.model, this.scene.data);
    this.mujoco.mj_fwdVelocity(this.scene.model, this.scene.data);
  }

  /** Return the weights, some of which the reader may have pinned, and the action for an observation and a goal. */
  async act(observation, goal) {
    const { state, loc, scale } = await this.primitives.run({ observation: row(observation) });
    const { gates } = await this.scene.network.run({ state, goal: row(goal) });
    for (const [primitive, weight] of this.pinned) gates.data[primitive] = weight;
    const { action } = await this.mixer.run({ loc, scale, gates });
    return { weights: Array.from(gates.data), action: Array.from(action.data) };
  }

  /** Advance by one physics step; the policy acts in every `substeps`-th step. */
  async advance() {
    const { model, data, task } = this.scene;
    const { num_bodies, action, substeps } = this.description;
    if (this.substep === 0) {
      const decision = await this.act(character_state(model, data, num_bodies), task.goal());
      if (task !== this.scene.task) return; // the reader has chosen another gate in the meantime
      this.weights = decision.weights;
      data.ctrl.set(decision.action.map((value, index) => action[index].centre + value * action[index].scale));
    }
    this.mujoco.mj_step(model, data);
    this.substep = (this.substep + 1) % substeps;
    if (this.substep > 0) return;
    this.refresh();
    task.after_step();
  }

  /** Whether the root is below half of its height in the rest pose. */
  get fallen() {
    return this.scene.data.xpos[5] < this.scene.model.qpos0[2] / 2;
  }

  /** Push the first body with a constant horizontal force in N until the next call. */
  push(x, y) {
    this.scene.data.xfrc_applied.set([x, y, 0], 6);
  }
}

const row = (values) => new ort.Tensor("float32", Float32Array.from(values), [1, values.length]);
