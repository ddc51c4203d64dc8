// Connects a page that draws for the display (docs/programs.md). `draw(asked, eye, rgba)` fills the bytes of a picture,
// starting with the bottom row.
export function connect(address, draw, name = document.title) {
  const socket = new WebSocket(address);
  socket.onopen = () => socket.send(JSON.stringify({ name, rows: "bottom-up" }));
  socket.onmessage = ({ data }) => {
    const asked = JSON.parse(data);
    for (const eye of asked.eyes) {
      const answer = new Uint8Array(8 + 4 * asked.width * asked.height), head = new DataView(answer.buffer);
      head.setUint32(0, asked.frame, true);
      head.setUint32(4, eye.eye === "left" ? 0 : 1, true);
      draw(asked, eye, answer.subarray(8));
      socket.send(answer);
    }
  };
  socket.onclose = () => setTimeout(() => connect(address, draw, name), 1000);
}
