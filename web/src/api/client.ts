/** How the console asks the service: one place for the key, for errors and for their words. */

import type { components, paths } from "./generated/schema";

/** What the service reads and answers, as its OpenAPI document has it. */
export type Schemas = components["schemas"];
export type Path = keyof paths;
type Places<P extends string> = P extends `${string}{${infer Name}}${infer Rest}`
  ? Record<Name, string | number> & Places<Rest>
  : unknown;

/** A path of the service with its {places} filled in. */
export function address<P extends Path>(path: P, places: Places<P>): string {
  const values = places as Record<string, string | number>;
  return path.replace(/\{(\w+)\}/g, (_, name: string) => encodeURIComponent(values[name]!));
}

const KEY_STORAGE = "ultragray.key";
const RETRY_MS = 2000;
const PASSING = [429, 502, 503, 504]; // full or starting; proxies answer 502 and 504 while the service starts anew

/** What the service answers in place of a result. */
export type Problem = Pick<Schemas["Problem"], "status" | "detail" | "reason"> & Partial<Pick<Schemas["Problem"], "field">> & { components?: Schemas["Components"] };

/** The service refused. */
export class ServiceError extends Error {
  constructor(
    readonly problem: Problem,
    /** When asking again may help; 0: the service does not say. */
    readonly retryAfter_s = 0,
  ) {
    super(problem.detail);
    this.name = "ServiceError";
  }
  get reason(): string {
    return this.problem.reason;
  }
}

/** Nobody answered: the service is down, or the network is. */
export class Unreachable extends Error {
  constructor() {
    super("The service does not answer.");
    this.name = "Unreachable";
  }
}

/** As tokens and headers hold bytes. */
export function base64url(bytes: Uint8Array): string {
  return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

/** One sentence for a person. */
export function explain(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

export function apiKey(): string | null {
  return sessionStorage.getItem(KEY_STORAGE);
}

/** Keeps the key until the tab is closed. */
export function setApiKey(key: string): void {
  sessionStorage.setItem(KEY_STORAGE, key);
}

export function forgetApiKey(): void {
  sessionStorage.removeItem(KEY_STORAGE);
}

/** The headers that every request needs. */
export function keyHeaders(): Record<string, string> {
  const key = apiKey();
  return key === null ? {} : { "X-API-Key": key };
}

/** Sends a request. Throws ServiceError for a status of 400 and above, Unreachable where nobody answers. */
export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  const headers = new Headers(init.headers);
  for (const [name, value] of Object.entries(keyHeaders())) headers.set(name, value);
  let response: Response;
  try {
    response = await fetch(path, { ...init, headers });
  } catch (error) {
    if (init.signal?.aborted) throw error;
    throw new Unreachable();
  }
  if (!response.ok) throw await refusalOf(response);
  return response;
}

/** Whether asking again may help: the service is down, full or starting. */
export function mayPass(error: unknown): boolean {
  return !(error instanceof ServiceError) || PASSING.includes(error.problem.status);
}

/** Whether the service answers, and only wants to be asked less often. */
export function isTooOften(error: unknown): boolean {
  return error instanceof ServiceError && error.problem.status === 429;
}

/** How long to wait before asking again: as the service says, `least_ms` at least. */
export function pauseAfter(error: unknown, least_ms: number): number {
  return Math.max(least_ms, error instanceof ServiceError ? 1000 * error.retryAfter_s : 0);
}

/**
 * Asks until the service answers; `told` hears what keeps it from it, a service that is down or full, each time. Throws
 * ServiceError for what asking again does not change, and what `ask` throws once the signal is aborted.
 */
export async function untilAnswered<T>(
  ask: () => Promise<T>,
  told: (error: unknown) => void,
  signal: AbortSignal,
): Promise<T> {
  for (;;) {
    let pause_ms: number;
    try {
      return await ask();
    } catch (error) {
      if (signal.aborted || !mayPass(error)) throw error;
      told(error);
      pause_ms = pauseAfter(error, RETRY_MS);
    }
    await new Promise((resolve) => setTimeout(resolve, pause_ms));
  }
}

/** Does something that asks as long as an effect holds: `told` hears what goes wrong until it ends, by what is returned. */
export function asking(
  work: (signal: AbortSignal, tell: (error: unknown) => void) => Promise<unknown>,
  told: (error: unknown) => void,
): () => void {
  const ending = new AbortController();
  const tell = (error: unknown): void => {
    if (!ending.signal.aborted) told(error);
  };
  work(ending.signal, tell).catch(tell);
  return () => ending.abort();
}

type AnswerTo<P extends Path, Method extends "get" | "post"> = paths[P] extends Record<
  Method,
  { responses: { 200: { content: { "application/json": infer Answer } } } }
>
  ? Answer
  : never;

/** The JSON that a GET of an address of `path` answers. */
export async function getJson<P extends Path>(
  path: P,
  places: Places<P>,
  { query = {}, signal = null }: { query?: Record<string, string>; signal?: AbortSignal | null } = {},
): Promise<AnswerTo<P, "get">> {
  const asked = new URLSearchParams(query).toString();
  const answer = await request(address(path, places) + (asked && `?${asked}`), { signal });
  return (await answer.json()) as AnswerTo<P, "get">;
}

/** What a POST answers, with or without a JSON body. */
export function post(
  path: string,
  body?: unknown,
  { accept = "application/json", signal = null }: { accept?: string; signal?: AbortSignal | null } = {},
): Promise<Response> {
  if (body === undefined) return request(path, { method: "POST", signal });
  const headers = { "Content-Type": "application/json", Accept: accept };
  return request(path, { method: "POST", body: JSON.stringify(body), headers, signal });
}

/** The JSON that a POST to an address of `path` answers. */
export async function postJson<P extends Path>(
  path: P,
  places: Places<P>,
  body?: unknown,
  signal: AbortSignal | null = null,
): Promise<AnswerTo<P, "post">> {
  return (await (await post(address(path, places), body, { signal })).json()) as AnswerTo<P, "post">;
}

/** A pose, 16 numbers row by row, as bodies of requests hold it. */
export function poseBody(pose: readonly number[]): { matrix: number[][] } {
  return { matrix: [0, 4, 8, 12].map((start) => pose.slice(start, start + 4)) };
}

/** Deletes what stands at an address of `path`. */
export async function remove<P extends Path>(path: P, places: Places<P>): Promise<void> {
  await request(address(path, places), { method: "DELETE" });
}

/** The refusal that an answer tells. */
export async function refusalOf(response: Response): Promise<ServiceError> {
  return new ServiceError(await problemOf(response), Number(response.headers.get("Retry-After")) || 0);
}

/** Reads a problem out of an answer; what is no problem document becomes one. */
async function problemOf(response: Response): Promise<Problem> {
  const text = await response.text();
  try {
    const document = JSON.parse(text) as Partial<Problem>;
    if (typeof document.reason === "string" && typeof document.detail === "string") return document as Problem;
  } catch {
    // not JSON: a proxy answered, say
  }
  const detail = `The service answered ${response.status} ${response.statusText}`.trim() + ".";
  return { status: response.status, detail, reason: "UNKNOWN" };
}
