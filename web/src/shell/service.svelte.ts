/** Whether the service answers, whether it wants a key, and whose that is. */

import { barredFor, whoAmI, type Me, type Operation } from "../api/access";
import { explain, forgetApiKey, getJson, isTooOften, pauseAfter, ServiceError } from "../api/client";
import { listScenes, type SceneEntry } from "../api/scenes";
import { forgetSession } from "../session/session.svelte";
import { words } from "../words/words.svelte";
import { login } from "./login.svelte";

const POLL_MS = 4000;
const POLL_DOWN_MS = 1000;

export type ServiceStatus = "asking" | "ready" | "starting" | "down" | "locked";

class ServiceState {
  status = $state<ServiceStatus>("asking");
  scenes = $state.raw<SceneEntry[]>([]);
  /** Those that can be read. */
  readonly usable = $derived(this.scenes.filter((scene) => scene.error == null));
  /** Why the service lets nobody in with this key, where it says more than that it does not know it. */
  refusal = $state<string | null>(null);
  /** Whom the key stands for; null: not known yet. */
  me = $state.raw<Me | null>(null);
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Asks now, and from now on. */
  async poll(): Promise<void> {
    clearTimeout(this.#timer);
    let refusal: unknown = null;
    try {
      await requireFrames();
      if (this.status !== "ready") this.me = await whoAmI();
      this.#take(await listScenes());
      this.status = "ready";
      this.refusal = null;
    } catch (error) {
      refusal = error;
      this.refusal = error instanceof ServiceError && error.problem.status === 403 ? explain(error) : null;
      if (!isTooOften(error)) this.status = statusOf(error);
      else if (this.status !== "ready") this.status = "asking";
    }
    clearTimeout(this.#timer);
    const least_ms = this.status === "ready" ? POLL_MS : POLL_DOWN_MS;
    this.#timer = setTimeout(() => void this.poll(), pauseAfter(refusal, least_ms));
  }

  /** Who may do an operation in place of who looks at the page, in words; null: they may. `owner`: of what it is about. */
  barred(operation: Operation, owner: string | null = null): string | null {
    const allowed = this.me && barredFor(this.me, operation, owner);
    return allowed && words.shell.key.allowed(allowed.roles, allowed.owner);
  }

  /** Lets go of the key and of all that was seen with it. */
  leave(): void {
    login.forget();
    forgetApiKey();
    location.reload();
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
  if (error.problem.status === 401 || error.problem.status === 403) return "locked"; // 403: without a role here
  return error.problem.status === 503 ? "starting" : "down";
}

export const service = new ServiceState();
