/** What can be rendered of a scene, as the service describes it. */

import { outputs } from "./generated/contract";
import type { Schemas } from "./client";

export type Output = Schemas["Scene"]["outputs"][number];

interface DescribedOutput {
  /** Whether its pixels are numbers that stand for something; else they are shares. */
  isNumbers: boolean;
}

export const OUTPUTS = Object.fromEntries(
  (outputs.items?.oneOf ?? []).map((one) => [
    one.const,
    { isNumbers: one["x-numbers"] ?? false },
  ]),
) as Record<Output, DescribedOutput>;
