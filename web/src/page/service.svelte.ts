/** The page and its service: whether it answers, whom the key or the login stands for, and the colours of the page. */

import { apiKey, base64url, explain, forgetApiKey, getJson, isTooOften, pauseAfter, ServiceError, setApiKey } from "../api/client";
import { listScenes, type SceneEntry } from "../api/scenes";
import { barredFor, type Me, type Operation, signInProvider, type SignInProvider, whoAmI } from "../api/service";
import { words } from "../words/words.svelte";

const ASKED = "ultragray.sign-in"; // in the storage of the tab, while the person is at the login
const RENEWAL = "ultragray.renewal";
const RENEWED_BEFORE_S = 30;
const LEAST_S = 5;
const TRIED_AGAIN_S = 15;

interface Asked {
  state: string;
  verifier: string;
  /** What the person looked at. */
  hash: string;
}

interface Renewal {
  token: string;
  /** Date.now() at which it is time. */
  due_ms: number;
}

/** What the login answers with, as far as it is of use here. */
interface Tokens {
  access_token?: string;
  id_token?: string;
  refresh_token?: string;
  expires_in?: number;
}

/** The login does not renew or give a token, and will not. */
class Refused extends Error {}

/** Signing in at the login of the hospital: OpenID Connect, an authorization code with PKCE (RFC 7636). */
class Login {
  /** null: people sign in with keys alone. */
  provider = $state.raw<SignInProvider | null>(null);
  /** Why signing in came to nothing. */
  problem = $state<string | null>(null);
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Where the login is, for people. */
  get place(): string {
    return this.provider === null ? "" : new URL(this.provider.authorization_endpoint).host;
  }

  /** Asks how people sign in, and ends a signing-in that this page comes back from. */
  async start(): Promise<void> {
    const query = new URLSearchParams(location.search);
    const isBack = query.has("state") && (query.has("code") || query.has("error"));
    const asked = taken<Asked>(ASKED);
    if (isBack) history.replaceState(null, "", location.pathname + location.hash);
    if (isBack && asked !== null && asked.hash !== "") location.replace(asked.hash);
    const isRenewed = taken<Renewal>(RENEWAL, { keep: true }) !== null && apiKey() !== null;
    if (!isBack && !isRenewed) return;
    try {
      this.provider = await signInProvider();
      if (isBack) await this.#finish(query, asked);
      else this.#renewLater();
    } catch (error) {
      this.problem = words.shell.login.failed(explain(error));
    }
  }

  /** Asks how people sign in, for the form that asks them to. */
  async look(): Promise<void> {
    try {
      this.provider = await signInProvider();
    } catch {
      this.provider = null; // with a key it goes on all the same
    }
  }

  /** Leaves for the login. */
  async leaveFor(provider: SignInProvider): Promise<void> {
    if (!globalThis.crypto?.subtle) {
      this.problem = words.shell.login.needsHttps;
      return;
    }
    const asked: Asked = { state: random(), verifier: random(), hash: location.hash };
    sessionStorage.setItem(ASKED, JSON.stringify(asked));
    const address = new URL(provider.authorization_endpoint);
    const given = {
      response_type: "code",
      client_id: provider.client_id,
      redirect_uri: here(),
      scope: provider.scope,
      state: asked.state,
      code_challenge: await challenge(asked.verifier),
      code_challenge_method: "S256",
    };
    for (const [name, value] of Object.entries(given)) address.searchParams.set(name, value);
    location.assign(address);
  }

  /** Lets go of what renews the token. */
  forget(): void {
    clearTimeout(this.#timer);
    sessionStorage.removeItem(RENEWAL);
  }

  async #finish(query: URLSearchParams, asked: Asked | null): Promise<void> {
    if (asked === null || asked.state !== query.get("state")) throw new Error(words.shell.login.notAsked);
    const refusal = query.get("error_description") ?? query.get("error");
    if (refusal !== null) throw new Error(refusal);
    await this.#take({ grant_type: "authorization_code", code: query.get("code")!, redirect_uri: here(), code_verifier: asked.verifier });
  }

  async #take(form: Record<string, string>): Promise<void> {
    const { token_endpoint, client_id } = this.provider ?? (await this.#required());
    const answer = await fetch(token_endpoint, { method: "POST", body: new URLSearchParams({ ...form, client_id }) });
    const tokens = (await answer.json()) as Tokens & { error?: string; error_description?: string };
    if (!answer.ok) {
      const reason = tokens.error_description ?? tokens.error ?? String(answer.status);
      throw answer.status < 500 ? new Refused(reason) : new Error(reason);
    }
    this.#keep(tokens); // first of all: the one before may be used up
    await use(tokens);
    this.#renewLater();
  }

  #keep(tokens: Tokens): void {
    if (tokens.refresh_token === undefined) return this.forget();
    const lasts_s = Math.max(LEAST_S, (tokens.expires_in ?? 60) - RENEWED_BEFORE_S);
    const renewal: Renewal = { token: tokens.refresh_token, due_ms: Date.now() + 1000 * lasts_s };
    sessionStorage.setItem(RENEWAL, JSON.stringify(renewal));
  }

  async #required(): Promise<SignInProvider> {
    this.provider = await signInProvider();
    if (this.provider === null) throw new Error(words.shell.login.away);
    return this.provider;
  }

  #renewLater(least_s = 0): void {
    clearTimeout(this.#timer);
    const renewal = taken<Renewal>(RENEWAL, { keep: true });
    if (renewal === null) return;
    this.#timer = setTimeout(() => void this.#renew(renewal), Math.max(1000 * least_s, renewal.due_ms - Date.now()));
  }

  /** A token that is refused ends by itself; the service then asks again. What does not answer is asked again. */
  async #renew({ token }: Renewal): Promise<void> {
    try {
      await this.#take({ grant_type: "refresh_token", refresh_token: token });
    } catch (error) {
      if (error instanceof Refused || (error instanceof ServiceError && error.problem.status === 401)) this.forget();
      else this.#renewLater(TRIED_AGAIN_S);
    }
  }
}

/** Takes the token that the service takes: the one for services, or the one that says who somebody is. */
async function use({ access_token, id_token }: Tokens): Promise<void> {
  const before = apiKey();
  let refusal: unknown = new Error(words.shell.login.noToken);
  for (const token of [access_token, id_token]) {
    if (token === undefined) continue;
    setApiKey(token);
    try {
      await whoAmI();
      return;
    } catch (error) {
      refusal = error;
      if (!(error instanceof ServiceError && error.problem.status === 401)) break;
    }
  }
  if (before === null) forgetApiKey();
  else setApiKey(before);
  throw refusal;
}

/** The address of this page as the login knows it. */
function here(): string {
  return location.origin + location.pathname;
}

function taken<Stored>(name: string, { keep = false } = {}): Stored | null {
  const text = sessionStorage.getItem(name);
  if (!keep) sessionStorage.removeItem(name);
  return text === null ? null : (JSON.parse(text) as Stored);
}

function random(): string {
  return base64url(crypto.getRandomValues(new Uint8Array(32)));
}

async function challenge(verifier: string): Promise<string> {
  return base64url(new Uint8Array(await crypto.subtle.digest("SHA-256", new TextEncoder().encode(verifier))));
}

export const login = new Login();

const POLL_MS = 4000;
const POLL_DOWN_MS = 1000;

export type ServiceStatus = "asking" | "ready" | "starting" | "down" | "locked";

/** Whether the service answers, whether it wants a key, and whose that is. */
class ServiceState {
  status = $state<ServiceStatus>("asking");
  scenes = $state.raw<SceneEntry[]>([]);
  /** Those that can be read. */
  readonly usable = $derived(this.scenes.filter((scene) => scene.error == null));
  /** Why the service lets nobody in with this key, where it says more than that it does not know it. */
  refusal = $state<string | null>(null);
  /** Whom the key stands for; null: not known yet. */
  me = $state.raw<Me | null>(null);
  #forgetting: ((scene: string) => void)[] = [];
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

  /** liver: liver-edited; the next one that is free where that is there. */
  freeName(scene: string, ending: string): string {
    const base = `${scene.replace(new RegExp(`-${ending}(-\\d+)?$`), "")}-${ending}`;
    const taken = new Set(this.scenes.map(({ name }) => name));
    for (let number = 1; ; number++) {
      const name = number === 1 ? base : `${base}-${number}`;
      if (!taken.has(name)) return name;
    }
  }

  /** Has what was kept of a scene let go where it is gone. */
  whenGone(forget: (scene: string) => void): void {
    this.#forgetting.push(forget);
  }

  /** Lets go of the key and of all that was seen with it. */
  leave(): void {
    login.forget();
    forgetApiKey();
    location.reload();
  }

  #take(scenes: SceneEntry[]): void {
    const names = new Set(scenes.map((scene) => scene.name));
    for (const { name } of this.scenes) if (!names.has(name)) for (const forget of this.#forgetting) forget(name);
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
