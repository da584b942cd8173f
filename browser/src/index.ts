export type { Pose } from "./pose.js";
export { Frame, Scene, type Extrapolation, type FrameInfo, type Output, type Picture, type SceneInfo, type Settings } from "./scene.js";
export { moved, type Motion } from "./steering.js";
export { UltragrayProbe } from "./probe.js";
export { isReached, offTarget, score, similarity, type Moment, type Score, type Task } from "./task.js";
export type { RendererChoice, RendererName } from "./worker.js";
