// MuJoCo and the networks in the browser: one character, and gates over its primitives.

import loadMujoco from "./runtimes/mujoco.js";
import * as ort from "./runtimes/ort.js";
import { character_state } from "./observations.js";
import { TASKS } from "./tasks.js";

const fetched = async (name) => {
  const response = await fetch(new URL(name, import.meta.url));
  if (!response.ok) throw new Error(`${name} is missing (${response.status}): copy the whole folder`);
  return response;
};

/** Content of a compressed file, also from a server that decompresses. */
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
  const known = new Map(); // clips share a scene and a network
  const once = async (make, name) => known.get(name) ?? known.set(name, await make(name)).get(name);
  for (const gate of description.gates) {
    if (gate.clip) gate.clip.rows = new Float32Array(await (await fetched(gate.clip.file)).arrayBuffer());
    const scene = { mujoco, gate, network: await once(session, gate.network), ...(await once(compiled, gate.scene)) };
    scenes.push({ ...scene, task: new TASKS[gate.task](scene) });
  }
  return new Simulation(description, scenes, primitives, mixer);
}

export class Simulation {
  scene = null;
  weights = []; // of the primitives
  pinned = new Map(); // weights that the reader holds, by primitive
  substep = 0;

  constructor(description, scenes, primitives, mixer) {
    Object.assign(this, { description, scenes, primitives, mixer, mujoco: scenes[0].mujoco });
    this.scene = scenes[0];
    this.reset();
  }

  get time() {
    return this.scene.data.time;
  }

  /** Begin an episode: the character stands at the origin. */
  reset() {
    const { model, data, task } = this.scene;
    this.mujoco.mj_resetData(model, data);
    task.start();
    this.mujoco.mj_forward(model, data);
    task.begin();
    this.refresh();
    this.substep = 0;
  }

  /** Go on with another gate: the character moves into the gate's scene as it is. */
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

  /** Update what is observed after a change of the state. */
  refresh() {
    this.mujoco.mj_fwdPosition(this.scene.model, this.scene.data);
    this.mujoco.mj_fwdVelocity(this.scene.model, this.scene.data);
  }

  /** Evaluate the networks: the gate's and the reader's weights, and the action, for an observation and a goal. */
  async act(observation, goal) {
    const { state, loc, scale } = await this.primitives.run({ observation: row(observation) });
    const { gates } = await this.scene.network.run({ state, goal: row(goal) });
    for (const [primitive, weight] of this.pinned) gates.data[primitive] = weight;
    const { action } = await this.mixer.run({ loc, scale, gates });
    return { weights: Array.from(gates.data), action: Array.from(action.data) };
  }

  /** Advance by a physics step; every few of them, the policy acts. */
  async advance() {
    const { model, data, task } = this.scene;
    const { num_bodies, action, substeps } = this.description;
    if (this.substep === 0) {
      const decision = await this.act(character_state(model, data, num_bodies), task.goal());
      if (task !== this.scene.task) return; // the reader has changed the gate meanwhile
      this.weights = decision.weights;
      data.ctrl.set(decision.action.map((value, index) => action[index].centre + value * action[index].scale));
    }
    this.mujoco.mj_step(model, data);
    this.substep = (this.substep + 1) % substeps;
    if (this.substep > 0) return;
    this.refresh();
    task.after_step();
  }

  /** Whether the root is less than half as high as in the rest pose. */
  get fallen() {
    return this.scene.data.xpos[5] < this.scene.model.qpos0[2] / 2;
  }

  /** Push the first body with a horizontal force in N, until the next call. */
  push(x, y) {
    this.scene.data.xfrc_applied.set([x, y, 0], 6);
  }
}

const row = (values) => new ort.Tensor("float32", Float32Array.from(values), [1, values.length]);
