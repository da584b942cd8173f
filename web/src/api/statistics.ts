/** The service in the last minutes. */

import { getJson, type Schemas } from "./client";

export type Statistics = Schemas["ServiceStatistics"];
export type StageTimes = Schemas["StageTimes"];

export function statistics(signal: AbortSignal): Promise<Statistics> {
  return getJson("/v1/statistics", {}, { signal });
}
