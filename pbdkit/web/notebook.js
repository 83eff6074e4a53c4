/** A notebook's line to its session: messages of the widget. */

import { mountLive } from "./live.js";

/** What the widget asks of its module. */
export function render({ model, el }) {
  const page = mountLive(el, (command) => model.send(command));
  const hear = (message, buffers) => {
    if (message.is !== "picture") return page.hear(message);
    const { buffer, byteOffset, byteLength } = buffers[0];
    page.see(buffer.slice(byteOffset, byteOffset + byteLength));
  };
  model.on("msg:custom", hear);
  model.send({ do: "join" });
  return () => {
    model.off("msg:custom", hear);
    page.close();
  };
}
