/** The page's line to its session: a socket of the server that the page came from. */

import { mountLive } from "./live.js";

const address = new URL("/socket" + location.search, location.href);
address.protocol = "ws:";
const socket = new WebSocket(address);
socket.binaryType = "arraybuffer";
const page = mountLive(document.body, (command) => {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(command));
});
socket.onmessage = ({ data }) => {
  if (typeof data === "string") page.hear(JSON.parse(data));
  else page.see(data);
};
socket.onclose = () => page.lost();
globalThis.pbdkitLive = page.live;
