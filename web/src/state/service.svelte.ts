/** Whether the service answers, and whether it wants a key. */

import { getJson, ServiceError } from "../api/client";
import { listScenes, type SceneEntry } from "../api/scenes";
import { forgetSession } from "./session.svelte";

const POLL_MS = 4000;
const POLL_DOWN_MS = 1000;

export type ServiceStatus = "asking" | "ready" | "starting" | "down" | "locked";

class ServiceState {
  status = $state<ServiceStatus>("asking");
  scenes = $state.raw<SceneEntry[]>([]);
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Asks now, and from now on. */
  async poll(): Promise<void> {
    clearTimeout(this.#timer);
    try {
      await requireFrames();
      this.#take(await listScenes());
      this.status = "ready";
    } catch (error) {
      this.status = statusOf(error);
    }
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => void this.poll(), this.status === "ready" ? POLL_MS : POLL_DOWN_MS);
  }

  #take(scenes: SceneEntry[]): void {
    const names = new Set(scenes.map((scene) => scene.name));
    for (const { name } of this.scenes) if (!names.has(name)) forgetSession(name);
    this.scenes = scenes;
  }
}

/** Throws where no frame would be rendered; jobs may be away. */
async function requireFrames(): Promise<void> {
  try {
    await getJson("/v1/health/ready", {});
  } catch (error) {
    if (!(error instanceof ServiceError && error.problem.components?.frames.ready)) throw error;
  }
}

function statusOf(error: unknown): ServiceStatus {
  if (!(error instanceof ServiceError)) return "down";
  if (error.problem.status === 401) return "locked";
  return error.problem.status === 503 ? "starting" : "down";
}

export const service = new ServiceState();
