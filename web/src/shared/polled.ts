/** What is asked for again and again while somebody looks at it. */

import { pauseAfter } from "../api/client";

/**
 * Asks now, and `every_ms` after each answer, later where the service wants that; `told` hears what went wrong. The
 * function that is returned ends it: nothing is taken or told after it.
 */
export function polled<Answer>(
  ask: (signal: AbortSignal) => Promise<Answer>,
  every_ms: number,
  taken: (answer: Answer) => void,
  told: (error: unknown) => void,
): () => void {
  const ending = new AbortController();
  const { signal } = ending;
  let timer: ReturnType<typeof setTimeout>;
  const begin = async (): Promise<void> => {
    let pause_ms = every_ms;
    try {
      const answer = await ask(signal);
      if (!signal.aborted) taken(answer);
    } catch (error) {
      if (!signal.aborted) told(error);
      pause_ms = pauseAfter(error, every_ms);
    }
    if (!signal.aborted) timer = setTimeout(() => void begin(), pause_ms);
  };
  void begin();
  return () => {
    clearTimeout(timer);
    ending.abort();
  };
}
