export type { Pose } from "./pose.js";
export { Frame, Scene, type Extrapolation, type FrameInfo, type Output, type Picture, type SceneInfo, type Settings } from "./scene.js";
export { moved, type Motion } from "./steering.js";
export { UltragrayProbe } from "./probe.js";
export type { RendererChoice, RendererName } from "./worker.js";
