/** Sending files, told how far it is: fetch cannot say. */

import { keyHeaders, refusalOf, Unreachable } from "./client";

/** Shares of the body that were sent, 0 to 1; 1 while the service checks what it got. */
export type Told = (share: number) => void;

/** PUTs a body. Throws ServiceError for a status of 400 and above, Unreachable, AbortError. */
export function putFile<T>(path: string, body: Blob | FormData, told: Told, signal: AbortSignal): Promise<T> {
  return new Promise<T>((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("PUT", path);
    for (const [name, value] of Object.entries(keyHeaders())) sending.setRequestHeader(name, value);
    if (body instanceof Blob) sending.setRequestHeader("Content-Type", body.type || "application/octet-stream");
    sending.upload.onprogress = (event) => told(event.lengthComputable ? event.loaded / event.total : 0);
    sending.upload.onload = () => told(1);
    sending.onerror = () => reject(new Unreachable());
    sending.onabort = () => reject(new DOMException("The upload was stopped.", "AbortError"));
    sending.onload = () => {
      if (sending.status < 400) return resolve(JSON.parse(sending.responseText) as T);
      const answer = new Response(sending.responseText, { status: sending.status, statusText: sending.statusText });
      void refusalOf(answer).then(reject);
    };
    signal.addEventListener("abort", () => sending.abort());
    sending.send(body);
  });
}
