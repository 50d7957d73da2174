// Draws the scene in the colours of the films: geoms of MuJoCo's model, arrows to targets, with a camera that follows.

import * as three from "three";
import { OrbitControls } from "./runtimes/OrbitControls.js";

three.ColorManagement.enabled = false; // MuJoCo adds light in the colour values of the screen
const HAZE = new three.Color(0.87, 0.9, 0.94); // the values below are those of scenery.py and film.py
const ZENITH = new three.Color(0.45, 0.62, 0.82);
const RED = new three.Color(0.9, 0.1, 0.1);
const [AZIMUTH, ELEVATION, DISTANCE, LAG] = [(115 * Math.PI) / 180, (-26 * Math.PI) / 180, 2.8, 0.25];
const [GROUND, PATTERN] = [60, 2]; // widths of the ground and of its pattern, in metres
const Z = new three.Vector3(0, 0, 1);

export class Drawing {
  constructor(canvas) {
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true });
    this.renderer.outputColorSpace = three.LinearSRGBColorSpace;
    this.renderer.shadowMap.enabled = true;
    this.camera = new three.PerspectiveCamera(45, 1, 0.05, 100);
    this.camera.up.copy(Z);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enablePan: false, maxPolarAngle: 1.5, minDistance: 1, maxDistance: 14 });
    this.picker = new three.Raycaster();
    this.headlight = new three.DirectionalLight("white", 0.35 * Math.PI);
    this.sun = sun();
    this.focus = new three.Vector3();
    this.ratio = Math.min(devicePixelRatio, 2); // pixels of the picture per pixel of the page
  }

  /** Show a scene; the camera stays where it is, except for the first scene. */
  show({ model, data }) {
    const first = !this.model;
    Object.assign(this, { model, data, scene: new three.Scene(), arrows: [] });
    this.scene.fog = new three.Fog(HAZE, 9, 28);
    this.scene.add(new three.AmbientLight("white", 0.38 * Math.PI), this.headlight, this.headlight.target);
    this.scene.add(this.sun, this.sun.target, (this.sky = sky()));
    this.geoms = [];
    for (let geom = 0; geom < model.ngeom; geom++) {
      const plane = SHAPES[model.geom_type[geom]] === undefined;
      if (model.geom_group[geom] > 2) continue;
      const mesh = plane ? ground(model, geom) : solid(model, geom);
      if (plane) this.ground = mesh;
      else this.geoms.push({ geom, mesh });
      this.scene.add(mesh);
    }
    if (first) this.stand();
  }

  /** Place the camera as in films. */
  stand() {
    const [distance, flat] = [DISTANCE * this.extent(), Math.cos(ELEVATION)];
    this.focus.fromArray(this.data.subtree_com, 3);
    this.controls.target.copy(this.focus);
    const way = new three.Vector3(flat * Math.cos(AZIMUTH), flat * Math.sin(AZIMUTH), Math.sin(ELEVATION));
    this.camera.position.copy(this.focus).addScaledVector(way, -distance);
  }

  /** Largest distance of the character from its centre of mass, in metres. */
  extent() {
    const { model, data } = this;
    const geoms = this.geoms.filter(({ geom }) => model.body_rootid[model.geom_bodyid[geom]] === 1);
    const centre = new three.Vector3().fromArray(data.subtree_com, 3);
    const place = new three.Vector3();
    return Math.max(...geoms.map(({ geom }) => {
      return place.fromArray(data.geom_xpos, 3 * geom).distanceTo(centre) + model.geom_rbound[geom];
    }));
  }

  /** Draw fewer pixels and no shadows, for devices that draw slowly. */
  lighten() {
    this.renderer.shadowMap.enabled = this.sun.castShadow = false;
    this.ratio = Math.max(this.ratio / 2, 0.5);
    this.resize(...this.size);
  }

  resize(width, height) {
    this.size = [width, height];
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.fov = width < height ? 58 : 45;
    this.camera.updateProjectionMatrix();
  }

  /** Draw the state and arrows, `seconds` after the last picture. */
  draw(arrows, seconds) {
    const { geom_xpos: places, geom_xmat: turns, subtree_com } = this.data;
    for (const { geom, mesh } of this.geoms) {
      const m = turns.subarray(9 * geom, 9 * geom + 9);
      const [x, y, z] = places.subarray(3 * geom, 3 * geom + 3);
      mesh.matrix.set(m[0], m[1], m[2], x, m[3], m[4], m[5], y, m[6], m[7], m[8], z, 0, 0, 0, 1);
      mesh.matrixWorldNeedsUpdate = true;
    }
    this.follow(new three.Vector3().fromArray(subtree_com, 3), seconds);
    while (this.arrows.length < arrows.length) this.scene.add(this.arrows[this.arrows.push(arrow()) - 1]);
    this.arrows.forEach((shape, index) => point(shape, arrows[index]));
    this.renderer.render(this.scene, this.camera);
  }

  follow(centre, seconds) {
    const jump = centre.distanceTo(this.focus) > 2; // an episode has begun
    const before = this.focus.clone();
    this.focus.lerp(centre, jump ? 1 : 1 - Math.exp(-seconds / LAG));
    const moved = this.focus.clone().sub(before);
    this.controls.target.add(moved);
    this.camera.position.add(moved);
    this.controls.update();
    this.headlight.position.copy(this.camera.position);
    this.headlight.target.position.copy(this.focus);
    this.sun.target.position.copy(this.focus).setZ(0);
    this.sun.position.copy(this.sun.target.position).add(new three.Vector3(3, -4, 10));
    this.sky.position.copy(this.camera.position);
    const nearest = (value) => PATTERN * Math.round(value / PATTERN);
    this.ground?.position.set(nearest(this.focus.x), nearest(this.focus.y), 0);
  }

  /** The point of the scene at a place of the picture, whose coordinates are from -1 to 1, or null without a hit. */
  pick(x, y) {
    this.picker.setFromCamera(new three.Vector2(x, y), this.camera);
    const [hit] = this.picker.intersectObjects([...this.geoms.map(({ mesh }) => mesh), this.ground]);
    if (!hit) return null;
    const body = this.model.geom_bodyid[hit.object.userData.geom];
    return { place: hit.point.toArray(), isCharacter: body > 0 && this.model.body_rootid[body] === 1 };
  }

  /** Horizontal direction in which the camera looks. */
  ahead() {
    const way = this.camera.getWorldDirection(new three.Vector3()).setZ(0).normalize();
    return [way.x, way.y];
  }
}

/** Geometries by the number of MuJoCo's type, with their axis along z. */
const SHAPES = {
  2: ([radius]) => new three.SphereGeometry(radius, 32, 20),
  3: ([radius, half]) => new three.CapsuleGeometry(radius, 2 * half, 8, 20).rotateX(Math.PI / 2),
  4: (size) => new three.SphereGeometry(1, 32, 20).scale(...size),
  5: ([radius, half]) => new three.CylinderGeometry(radius, radius, 2 * half, 32).rotateX(Math.PI / 2),
  6: (size) => new three.BoxGeometry(...size.map((half) => 2 * half)),
};

function solid(model, geom) {
  const size = Array.from(model.geom_size.subarray(3 * geom, 3 * geom + 3));
  const map = pattern(model, geom);
  const shape = map && model.geom_type[geom] === 2 ? ball(size[0]) : SHAPES[model.geom_type[geom]](size);
  const [red, green, blue, opacity] = rgba(model, geom);
  const paint = { color: new three.Color(red, green, blue), map, opacity, transparent: opacity < 1 };
  const mesh = new three.Mesh(shape, new three.MeshLambertMaterial(paint));
  Object.assign(mesh, { matrixAutoUpdate: false, castShadow: opacity === 1, receiveShadow: true, userData: { geom } });
  return mesh;
}

/** Colour and opacity of a geom, or of its material if the geom has MuJoCo's default colour. */
function rgba(model, geom) {
  const colour = Array.from(model.geom_rgba.subarray(4 * geom, 4 * geom + 4));
  const material = model.geom_matid[geom];
  const isDefault = colour.join() === "0.5,0.5,0.5,1";
  return material >= 0 && isDefault ? model.mat_rgba.subarray(4 * material, 4 * material + 4) : colour;
}

/** The first square of the texture of a geom's material, or null without a texture. */
function pattern(model, geom) {
  const material = model.geom_matid[geom];
  const texture = material < 0 ? -1 : model.mat_texid[model.mat_texid.length / model.nmat * material + 1];
  if (texture < 0) return null;
  const [width, start, channels] = [model.tex_width, model.tex_adr, model.tex_nchannel].map((field) => field[texture]);
  const pixels = new Uint8Array(4 * width * width).fill(255);
  for (let index = 0; index < width * width; index++) {
    for (let channel = 0; channel < 3; channel++) {
      pixels[4 * index + channel] = model.tex_data[Number(start) + channels * index + channel];
    }
  }
  const map = new three.DataTexture(pixels, width, width);
  Object.assign(map, { wrapS: three.RepeatWrapping, wrapT: three.RepeatWrapping, anisotropy: 8, generateMipmaps: true });
  Object.assign(map, { minFilter: three.LinearMipmapLinearFilter, magFilter: three.LinearFilter, needsUpdate: true });
  return map;
}

/** A sphere with the same picture on six sides, as MuJoCo wraps the texture of a cube. */
function ball(radius) {
  const shape = new three.BoxGeometry(1, 1, 1, 12, 12, 12);
  const { position, normal } = shape.attributes;
  const vertex = new three.Vector3();
  for (let index = 0; index < position.count; index++) {
    vertex.fromBufferAttribute(position, index).normalize();
    normal.setXYZ(index, vertex.x, vertex.y, vertex.z);
    position.setXYZ(index, radius * vertex.x, radius * vertex.y, radius * vertex.z);
  }
  return shape;
}

function ground(model, geom) {
  const map = pattern(model, geom);
  map?.repeat.set(GROUND / PATTERN, GROUND / PATTERN);
  const paint = new three.MeshLambertMaterial(map ? { map } : { color: new three.Color(0.66, 0.7, 0.74) });
  const mesh = new three.Mesh(new three.PlaneGeometry(GROUND, GROUND), paint);
  return Object.assign(mesh, { receiveShadow: true, userData: { geom } });
}

/** A dome whose colour changes from haze at the horizon to the colour of the sky at the zenith. */
function sky() {
  const dome = new three.SphereGeometry(40, 32, 24).rotateX(Math.PI / 2);
  const heights = dome.attributes.position;
  const colours = Array.from({ length: heights.count }, (_, index) => {
    return HAZE.clone().lerp(ZENITH, Math.max(heights.getZ(index) / 40, 0)).toArray();
  });
  dome.setAttribute("color", new three.Float32BufferAttribute(colours.flat(), 3));
  const paint = { side: three.BackSide, vertexColors: true, fog: false, depthWrite: false };
  return new three.Mesh(dome, new three.MeshBasicMaterial(paint));
}

function sun() {
  const light = new three.DirectionalLight("white", 0.55 * Math.PI);
  light.castShadow = true;
  light.shadow.mapSize.set(2048, 2048);
  light.shadow.normalBias = 0.02;
  Object.assign(light.shadow.camera, { left: -6, right: 6, top: 6, bottom: -6, near: 1, far: 24 });
  return light;
}

function arrow() {
  const paint = new three.MeshLambertMaterial({ color: RED });
  const shaft = new three.CylinderGeometry(0.03, 0.03, 1, 20).rotateX(Math.PI / 2).translate(0, 0, 0.5);
  const tip = new three.ConeGeometry(0.08, 0.2, 24).rotateX(Math.PI / 2).translate(0, 0, -0.1);
  const shape = new three.Group().add(new three.Mesh(shaft, paint), new three.Mesh(tip, paint));
  shape.children.forEach((part) => (part.castShadow = true));
  return shape;
}

/** Draw an arrow from a tail to a tip, or hide it without ends. */
function point(shape, ends) {
  const [tail, tip] = (ends ?? [[0, 0, 0], [0, 0, 0]]).map((end) => new three.Vector3(...end));
  const way = tip.clone().sub(tail);
  const length = way.length();
  shape.visible = length > 0.05;
  shape.position.copy(tail);
  shape.quaternion.setFromUnitVectors(Z, way.normalize());
  const [shaft, cone] = shape.children;
  shaft.scale.z = Math.max(length - 0.2, 0.01);
  cone.position.z = length;
}
