/** What lies between a page and the service on a poor network: it can refuse streams, cut them and leave them dead. */

import { createServer, request } from "node:http";
import { connect } from "node:net";

const REFUSED = "HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

export class Proxy {
  /** Whether WebSockets are refused. */
  refuses = false;
  #pairs = new Set();

  /** One in front of the service, with an address of its own. */
  static async start(service) {
    const proxy = new Proxy();
    proxy.#server = createServer((asked, answer) => {
      const { method, url, headers } = asked;
      const passed = request({ host: "127.0.0.1", port: service.port, method, path: url, headers }, (response) => {
        answer.writeHead(response.statusCode, response.headers);
        response.pipe(answer);
      });
      passed.on("error", () => answer.destroy());
      asked.pipe(passed);
    });
    proxy.#server.on("upgrade", (asked, socket) => proxy.#upgrade(asked, socket, service.port));
    await new Promise((resolve) => proxy.#server.listen(0, "127.0.0.1", resolve));
    proxy.url = `http://127.0.0.1:${proxy.#server.address().port}`;
    return proxy;
  }

  #server;

  #upgrade(asked, socket, port) {
    socket.on("error", () => undefined);
    if (this.refuses) return socket.end(REFUSED);
    const there = connect(port, "127.0.0.1");
    const pair = { socket, there, dead: false };
    this.#pairs.add(pair);
    const headers = asked.rawHeaders.map((text, i) => (i % 2 === 0 ? `${text}: ` : `${text}\r\n`)).join("");
    there.write(`${asked.method} ${asked.url} HTTP/1.1\r\n${headers}\r\n`);
    for (const [from, to] of [[socket, there], [there, socket]]) {
      from.on("data", (data) => pair.dead || to.write(data));
      from.on("error", () => undefined);
      from.on("close", () => {
        if (pair.dead) return;
        this.#pairs.delete(pair);
        to.destroy();
      });
    }
  }

  /** Ends the streams that are open. */
  cut() {
    for (const { socket } of this.#pairs) socket.destroy();
  }

  /** Passes nothing on any more in the streams that are open, and does not say so. */
  silence() {
    for (const pair of this.#pairs) pair.dead = true;
  }

  stop() {
    for (const { socket, there } of this.#pairs) for (const one of [socket, there]) one.destroy();
    this.#server.closeAllConnections();
    return new Promise((resolve) => this.#server.close(resolve));
  }
}
