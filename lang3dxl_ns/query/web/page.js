// A scene to walk through, and words answered beforehand as heat on its Gaussians.
import { Color, OrbitControls, PerspectiveCamera, Scene, SparkRenderer, SplatMesh, Vector3, WebGLRenderer } from "./splats.js";

const description = await (await fetch("scene.json")).json();
const renderer = new WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
document.body.prepend(renderer.domElement);
const scene = new Scene(), camera = new PerspectiveCamera(50, 1, description.near, description.far);
camera.up.fromArray(description.up);
scene.add(new SparkRenderer({ renderer }));
const splats = new SplatMesh({ url: description.splats });
scene.add(splats);
const controls = new OrbitControls(camera, renderer.domElement);

// ── colors ──
const colors = [];
const heats = new Map();
let shown = -1;

async function show(index) {
  shown = index === shown ? -1 : index;
  const word = description.words[shown];
  if (word && !heats.has(shown)) heats.set(shown, new Uint8Array(await (await fetch(word.heat)).arrayBuffer()));
  const heat = word && heats.get(shown);
  const color = new Color(), table = description.colors, half = word ? 255 * word.threshold : 0;
  const range = Math.max(word ? 255 * word.highest - half : 1, 1);
  splats.packedSplats.forEachSplat((i, center, scales, quaternion, opacity) => {
    color.copy(colors[i]);
    if (heat && heat[i] > half) {
      const [r, g, b] = table[Math.min(Math.round((255 * (heat[i] - half)) / range), 255)];
      color.lerp(new Color(r, g, b), 0.7);
    }
    splats.packedSplats.setSplat(i, center, scales, quaternion, opacity, color);
  });
  splats.packedSplats.needsUpdate = true;
  splats.updateVersion();
  document.querySelectorAll(".word").forEach((b, i) => b.setAttribute("aria-pressed", i === shown));
  window.shownWord = word ? word.text : null;
}

// ── flying ──
let flight = null;

function stand(view) {
  const pose = view.pose, position = new Vector3(pose[0][3], pose[1][3], pose[2][3]);
  const ahead = new Vector3(-pose[0][2], -pose[1][2], -pose[2][2]);
  // The whole photo fits into the window.
  const high = Math.tan(view.high / 2), wide = Math.tan(view.wide / 2);
  const fov = (360 / Math.PI) * Math.atan(Math.max(high, wide / camera.aspect));
  return { position, target: position.clone().addScaledVector(ahead, view.distance), fov };
}

function place({ position, target, fov }) {
  camera.position.copy(position);
  controls.target.copy(target);
  camera.fov = fov;
  camera.updateProjectionMatrix();
  controls.update();
}

function flyTo(view) {
  const from = { position: camera.position.clone(), target: controls.target.clone(), fov: camera.fov };
  flight = { from, to: stand(view), start: performance.now() };
}

function step(now) {
  if (flight) {
    let t = Math.min((now - flight.start) / 1200, 1);
    const { from, to } = flight, s = t * t * (3 - 2 * t);
    place({
      position: from.position.clone().lerp(to.position, s),
      target: from.target.clone().lerp(to.target, s),
      fov: from.fov + (to.fov - from.fov) * s,
    });
    if (t === 1) flight = null;
  }
  controls.update();
  renderer.render(scene, camera);
}

function resize() {
  renderer.setSize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}

// ── panel ──
function button(row, label, className, act) {
  const element = document.createElement("button");
  element.textContent = label;
  element.className = className;
  element.addEventListener("click", act);
  row.append(element);
}

document.title = description.title;
document.getElementById("credit").textContent = description.credit;
addEventListener("resize", resize);
renderer.domElement.addEventListener("pointerdown", () => (flight = null));
resize();
place(stand(description.start));
await splats.initialized;
splats.packedSplats.forEachSplat((i, center, scales, quaternion, opacity, color) => (colors[i] = color.clone()));
const panel = document.getElementById("panel"), status = document.getElementById("status");
status.textContent = description.title;
description.words.forEach((word, i) => {
  const row = document.createElement("div");
  button(row, word.text, "word", () => show(i));
  button(row, "Fly to", "fly", () => flyTo(word.view));
  panel.append(row);
});
const row = document.createElement("div");
button(row, "Overview", "overview", () => flyTo(description.start));
panel.append(row);
renderer.setAnimationLoop(step);
window.ready = true;
