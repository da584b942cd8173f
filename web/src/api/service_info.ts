/** What the service is, and where its other doors are. */

import { getJson, type Schemas } from "./client";

export type ServiceInfo = Schemas["ServiceInfo"];

export function serviceInfo(): Promise<ServiceInfo> {
  return getJson("/v1/service", {});
}
