// Reads a black box with @mcap/core, which shares no code with ours or with the Python library, and tells what is in it
// as one JSON object:  NODE_PATH=.../node_modules node second_reader.mjs FILE.mcap
import { createRequire } from "node:module";
import { open } from "node:fs/promises";

const find = createRequire((process.env.NODE_PATH ?? process.cwd()) + "/x");
const { McapIndexedReader } = find("@mcap/core");
const file = await open(process.argv[2]);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, size) => {
    const buffer = new Uint8Array(Number(size));
    await file.read(buffer, 0, Number(size), Number(offset));
    return buffer;
  },
};
const lz4 = find(process.env.LZ4_MODULE ?? "lz4js");
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { lz4: (data, size) => lz4.decompress(data, Number(size)) },
});
const told = { library: reader.header.library, topics: {}, states: [], first_ns: null, last_ns: null };
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  const value = JSON.parse(new TextDecoder().decode(message.data));
  const topic = (told.topics[channel.topic] ??= { schema: schema.name, encoding: channel.messageEncoding, count: 0 });
  topic.count += 1;
  if (channel.topic === "/state") told.states.push(value.state);
  told.first_ns ??= String(message.logTime);
  told.last_ns = String(message.logTime);
}
console.log(JSON.stringify(told));
