// Compile a scene with the browser's MuJoCo, and print MuJoCo's version and the fields of the model, or the error, as JSON.
//   node check.mjs RUNTIMES < scene.xml

import fs from "node:fs";
import { gunzipSync } from "node:zlib";
import { pathToFileURL } from "node:url";

const FIELDS = ["body_mass", "body_inertia", "body_pos", "jnt_range", "dof_damping", "dof_armature", "geom_size", "geom_friction",
  "geom_solref", "geom_solimp", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange", "qpos0"];

const folder = process.argv[2];
const { default: load } = await import(pathToFileURL(`${folder}/mujoco.js`));
const mujoco = await load({ wasmBinary: gunzipSync(fs.readFileSync(`${folder}/mujoco.wasm.gz`)), printErr: () => {} });
const report = { version: mujoco.mj_versionString() };
try {
  const model = mujoco.MjModel.from_xml_string(fs.readFileSync(0, "utf8"));
  report.fields = Object.fromEntries(FIELDS.map((name) => [name, Array.from(model[name])]));
} catch (error) {
  report.error = String(error?.message ?? error);
}
console.log(JSON.stringify(report));
