// Reads and decodes streams by the C core, and plays them on a controller: messages.js comes first, no other library.
"use strict";

/** A fault with its cause and an action, in words for the reader of the page. */
class Problem extends Error {}

// ---- bytes ----

/** Takes numbers and pieces from the front of bytes. */
class Reader {
    /**
     * @param {Uint8Array} bytes
     * @param {() => Error} cut - Returns what to throw where the bytes end too early.
     */
    constructor(bytes, cut) {
        this.bytes = bytes;
        this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
        this.position = 0;
        this.cut = cut;
    }

    get left() {
        return this.bytes.length - this.position;
    }

    /** @param {number} length @returns {Uint8Array} a view of the next bytes */
    take(length) {
        if (length > this.left) throw this.cut();
        this.position += length;
        return this.bytes.subarray(this.position - length, this.position);
    }

    /** @param {string} kind - A kind of number in FORMATS. @returns {number} */
    number(kind) {
        const [size, read] = FORMATS[kind];
        this.take(size);
        return read(this.view, this.position - size);
    }

    /** @returns {number} a number as LEB128, exact below 2^53 */
    varint() {
        let value = 0;
        for (let factor = 1; factor < 2 ** 63; factor *= 128) {
            const byte = this.number("u8");
            value += (byte & 0x7f) * factor;
            if (byte < 0x80) return value;
        }
        throw this.cut();
    }
}

/** @type {Record<string, [number, (view: DataView, at: number) => number, (view: DataView, value: number) => void]>} */
const FORMATS = {
    u8: [1, (view, at) => view.getUint8(at), (view, value) => view.setUint8(0, value)],
    u16: [2, (view, at) => view.getUint16(at, true), (view, value) => view.setUint16(0, value, true)],
    u32: [4, (view, at) => view.getUint32(at, true), (view, value) => view.setUint32(0, value, true)],
    u64: [
        8,
        (view, at) => Number(view.getBigUint64(at, true)),
        (view, value) => view.setBigUint64(0, BigInt(value), true),
    ],
    i64: [
        8,
        (view, at) => Number(view.getBigInt64(at, true)),
        (view, value) => view.setBigInt64(0, BigInt(value), true),
    ],
    f32: [4, (view, at) => view.getFloat32(at, true), (view, value) => view.setFloat32(0, value, true)],
};

/** @param {string} kind @param {number} value @returns {Uint8Array} */
function numberBytes(kind, value) {
    const [size, , write] = FORMATS[kind];
    const bytes = new Uint8Array(size);
    write(new DataView(bytes.buffer), value);
    return bytes;
}

/** @param {number} value - A whole number from 0 to 2^53. @returns {Uint8Array} its LEB128 */
function varintBytes(value) {
    const bytes = [];
    for (; value >= 128; value = Math.floor(value / 128)) bytes.push((value % 128) | 0x80);
    return Uint8Array.of(...bytes, value);
}

/** @param {Uint8Array[]} pieces @returns {Uint8Array} */
function joined(pieces) {
    const bytes = new Uint8Array(pieces.reduce((sum, piece) => sum + piece.length, 0));
    let at = 0;
    for (const piece of pieces) {
        bytes.set(piece, at);
        at += piece.length;
    }
    return bytes;
}

// ---- messages ----

/** @typedef {[name: string, kind: string]} FieldLayout */
/** @typedef {{ name: string, kind: string, list: boolean, optional: boolean }} TagLayout */
/** @typedef {{ type: number | null, fields: FieldLayout[], tags: Record<number, TagLayout> }} Layout */

/** @param {string} kind @param {any} value @returns {Uint8Array} */
function fieldBytes(kind, value) {
    if (kind in FORMATS) return numberBytes(kind, value);
    if (kind === "varint") return varintBytes(value);
    if (kind === "text") return new TextEncoder().encode(value);
    if (kind === "items")
        return joined(value.flatMap((/** @type {Uint8Array} */ item) => [varintBytes(item.length), item]));
    if (kind === "counted") {
        const text = new TextEncoder().encode(value);
        return joined([Uint8Array.of(text.length), text]);
    }
    return kind in LAYOUTS ? structBytes(LAYOUTS[kind], value) : value;
}

/** @param {Layout} layout @param {Record<string, any>} values @returns {Uint8Array} */
function structBytes(layout, values) {
    const pieces = layout.fields.map(([name, kind]) => fieldBytes(kind, values[name]));
    for (const [number, { name, kind, list }] of Object.entries(layout.tags))
        for (const each of list ? values[name] : values[name] === null ? [] : [values[name]]) {
            const value = fieldBytes(kind, each);
            pieces.push(Uint8Array.of(Number(number)), numberBytes("u16", value.length), value);
        }
    return joined(pieces);
}

/** @param {string} kind @param {Reader} reader @returns {any} */
function readField(kind, reader) {
    if (kind in FORMATS) return reader.number(kind);
    if (kind === "varint") return reader.varint();
    if (kind === "text") return new TextDecoder().decode(reader.take(reader.left));
    if (kind === "counted") return new TextDecoder().decode(reader.take(reader.number("u8")));
    if (kind === "bytes") return reader.take(reader.left);
    if (kind !== "items") return reader.take(Number(kind));
    const items = [];
    while (reader.left > 0) items.push(reader.take(reader.varint()));
    return items;
}

/** @param {Layout} layout @param {Reader} reader @returns {Record<string, any>} */
function readStruct(layout, reader) {
    /** @type {Record<string, any>} */
    const values = {};
    for (const [name, kind] of layout.fields) values[name] = readField(kind, reader);
    const tags = Object.values(layout.tags);
    for (const { name, kind, list, optional } of tags)
        if (optional) values[name] = null;
        else values[name] = list ? [] : kind === "text" ? "" : kind === "bytes" ? new Uint8Array() : undefined;
    while (layout.type !== null && reader.left > 0) {
        const tag = layout.tags[reader.number("u8")];
        const value = new Reader(reader.take(reader.number("u16")), reader.cut);
        if (tag === undefined) continue; // of a later minor version
        const read = tag.kind in LAYOUTS ? readStruct(LAYOUTS[tag.kind], value) : readField(tag.kind, value);
        if (tag.list) values[tag.name].push(read);
        else values[tag.name] = read;
    }
    if (tags.some(({ name }) => values[name] === undefined)) throw reader.cut();
    return values;
}

/**
 * Returns a message as the payload of a frame. Stream data carry no sequence number.
 * @template {keyof Messages} K
 * @param {K} name
 * @param {Messages[K]} values
 * @param {number} [sequence]
 * @returns {Uint8Array}
 */
function packMessage(name, values, sequence = 0) {
    const type = /** @type {number} */ (LAYOUTS[name].type);
    const sequenced = type < FIRST_UNSEQUENCED || type >= FIRST_FROM_CONTROLLER;
    const head = sequenced ? [Uint8Array.of(type), numberBytes("u16", sequence)] : [Uint8Array.of(type)];
    return joined([...head, structBytes(LAYOUTS[name], values)]);
}

/**
 * @param {Uint8Array} payload
 * @returns {{ name: keyof Messages, values: any, sequence: number } | null} null: a message that cannot be read
 */
function unpackMessage(payload) {
    const found = Object.entries(LAYOUTS).find(([, layout]) => layout.type === payload[0]);
    if (found === undefined) return null;
    const reader = new Reader(payload, () => new RangeError("a cut message"));
    try {
        const type = reader.number("u8");
        const sequenced = type < FIRST_UNSEQUENCED || type >= FIRST_FROM_CONTROLLER;
        const sequence = sequenced ? reader.number("u16") : 0;
        return { name: /** @type {keyof Messages} */ (found[0]), values: readStruct(found[1], reader), sequence };
    } catch (error) {
        if (error instanceof RangeError) return null;
        throw error;
    }
}

// ---- streams ----

const UNITS = ["full scale", "m/s²", "µm", "µm over position"];
const PROFILE_UNIT = 3;
const STREAM_FORMAT = 0xd3;
const HAS_IMAGE_HASH = 4;
const ONE_PACKET = 8;
const LONG_CONFIGURATION = 15;
const MAX_SAMPLES = 2 ** 25;
const CRC_START = 0xffff;
const NO_CODEC = -7; // of vibrocast/status.h
const TOO_SMALL = -9;

/**
 * A coded stream. `header`: its bytes in Configure. `samples`: per channel, null where the file leaves it open.
 * `unit`: an index into UNITS. `gains`: value of full scale in that unit, per channel. `packets`: each with its head.
 * @typedef {{ header: Uint8Array, codec: number, channels: number, rateHz: number, samples: number | null,
 *     unit: number, gains: number[], needsImage: boolean, packets: Uint8Array[], fileBytes: number }} Stream
 */
/**
 * Decoded samples: interleaved, 32768 = full scale, of all packets. `samples`: per channel, without the codec's delay.
 * @typedef {{ integers: Int16Array, packetSamples: number, delaySamples: number, samples: number }} Decoded
 */

/** The C core as a WebAssembly module. */
class Core {
    /** @param {BufferSource} module @returns {Promise<Core>} */
    static async load(module) {
        const { instance } = await WebAssembly.instantiate(module);
        return new Core(instance.exports);
    }

    /** @param {any} functions - What firmware/ports/wasm/module.c exports. */
    constructor(functions) {
        this.functions = functions;
        this.base = (functions.__heap_base.value + 7) & ~7;
    }

    /**
     * Puts pieces into the core's memory, and makes room behind them.
     * @param {Uint8Array[]} pieces
     * @param {number} [room] - Bytes behind the pieces.
     * @returns {number[]} the address of each piece, then that of the room
     */
    place(pieces, room = 0) {
        /** @type {number[]} */
        const addresses = [];
        let end = this.base;
        for (const length of [...pieces.map((piece) => piece.length), room]) {
            addresses.push(end);
            end = (end + length + 7) & ~7;
        }
        this.grow(end);
        pieces.forEach((piece, index) => this.memory().set(piece, addresses[index]));
        return addresses;
    }

    /** Gives the core memory up to an address. @param {number} end */
    grow(end) {
        const { memory } = this.functions;
        if (end > memory.buffer.byteLength) memory.grow(Math.ceil((end - memory.buffer.byteLength) / 65536));
    }

    /** Throws for a status that is an error. @param {number} status @param {number} [expected] - No error. */
    check(status, expected = 0) {
        if (status >= 0 || status === expected) return;
        if (status === NO_CODEC) throw new Problem("This page lacks the stream's codec. Use `vibrocast decode`.");
        const memory = this.memory();
        const text = this.functions.status_text(status);
        const reason = new TextDecoder().decode(memory.slice(text, memory.indexOf(0, text)));
        throw new Problem(`The stream cannot be decoded: ${reason}.`);
    }

    /** @returns {Uint8Array} all memory; valid until the next call that grows it */
    memory() {
        return new Uint8Array(this.functions.memory.buffer);
    }

    /** @param {Uint8Array} bytes @param {number} [start] @returns {number} CRC-16, going on from that of bytes before */
    crc16(bytes, start = CRC_START) {
        return this.functions.crc16(this.place([bytes])[0], bytes.length, start);
    }

    /** @param {Uint8Array} payload @returns {Uint8Array} the frame of a message, with its delimiter */
    frame(payload) {
        const bytes = joined([payload, numberBytes("u16", this.crc16(payload))]);
        const [data, encoded] = this.place([bytes], bytes.length + Math.floor(bytes.length / 254) + 1);
        const length = this.functions.cobs_encode(data, bytes.length, encoded);
        return joined([this.memory().slice(encoded, encoded + length), Uint8Array.of(0)]);
    }

    /** @param {Uint8Array} frame - Without its delimiter. @returns {Uint8Array | null} its payload; null: damaged */
    payload(frame) {
        const [address] = this.place([frame]);
        const length = this.functions.cobs_decode(address, frame.length);
        if (length < 3) return null;
        const bytes = this.memory().slice(address, address + length);
        const [payload, crc] = [bytes.subarray(0, -2), bytes.subarray(-2)];
        return this.crc16(payload) === crc[0] + 256 * crc[1] ? payload : null;
    }

    /**
     * Reads the bytes of a .vct file; docs/reference/bitstream.md describes them.
     * @param {Uint8Array} file
     * @returns {Stream}
     */
    read(file) {
        const reader = new Reader(file, () => new Problem("The file is damaged: it ends too early. Copy it again."));
        if (file.length < 2 || file[0] >> 4 !== STREAM_FORMAT >> 4)
            throw new Problem(
                "This is no coded stream: it does not begin as one. Choose a .vct file, which `vibrocast encode` writes.",
            );
        if (reader.number("u8") !== STREAM_FORMAT)
            throw new Problem(
                `The stream has format ${file[0] & 15}, and this page reads format ${STREAM_FORMAT & 15}. Encode the recording again.`,
            );
        const codecAndLength = reader.number("u8");
        const flags = reader.number("u8");
        const channels = (flags >> 4) + 1;
        const rate = reader.varint();
        const samples = reader.varint() - 1;
        const gains = Array.from({ length: channels }, () => {
            const upper = reader.number("u16");
            return new DataView(Uint8Array.of(0, 0, upper & 255, upper >> 8).buffer).getFloat32(0, true);
        });
        reader.take(flags & HAS_IMAGE_HASH ? 4 : 0);
        const length = codecAndLength & 15;
        reader.take(length === LONG_CONFIGURATION ? reader.number("u8") : length);
        let crc = this.crc16(file.subarray(0, reader.position));
        const header = file.slice(0, reader.position);
        header[2] &= ~ONE_PACKET; // a file's own
        /** @type {Uint8Array[]} */
        const packets = [];
        while (reader.left > 0 || packets.length === 0) {
            const start = reader.position;
            const head = flags & ONE_PACKET ? 2 * Math.max(0, reader.left - 2) + 1 : reader.varint();
            const payload = reader.take(Math.floor(head / 2));
            crc = this.crc16(file.subarray(start, reader.position), crc);
            if (reader.number("u16") !== crc)
                throw new Problem(`The file is damaged: packet ${packets.length} fails its checksum. Copy it again.`);
            packets.push(joined([varintBytes(2 * packets.length + (head % 2)), payload]));
        }
        return {
            header,
            codec: codecAndLength >> 4,
            channels,
            rateHz: rate % 2 ? (rate - 1) / 2 : 50 * rate,
            samples: samples < 0 ? null : samples,
            unit: flags & 3,
            gains,
            needsImage: (flags & HAS_IMAGE_HASH) !== 0,
            packets,
            fileBytes: file.length,
        };
    }

    /**
     * Decodes all packets, to the same integers as every other decoder of this project.
     * @param {Stream} stream
     * @param {Uint8Array} [image] - The bytes of the .vcmi file that the stream was coded for.
     * @returns {Decoded}
     */
    decode(stream, image = new Uint8Array()) {
        if (stream.needsImage && image.length === 0)
            throw new Problem(
                "The stream needs the model that it was coded for. Choose the stream and its .vcmi file together.",
            );
        // All that follows stays in place: the decoder reads the model, and keeps its state in its memory.
        const [header, model, memory] = this.place([stream.header, image]);
        const bytes = [header, stream.header.length, model, image.length, memory];
        this.check(this.functions.open_stream(...bytes, 0), TOO_SMALL);
        const packetAt = memory + this.functions.needed_bytes();
        this.grow(packetAt);
        this.check(this.functions.open_stream(...bytes, packetAt - memory));
        const packetSamples = this.functions.packet_samples();
        const delaySamples = this.functions.delay_samples();
        const samples = stream.samples ?? stream.packets.length * packetSamples - delaySamples;
        const needed = Math.ceil((samples + delaySamples) / packetSamples);
        if (samples < 1 || stream.packets.length !== needed)
            throw new Problem(`The file has ${stream.packets.length} packets instead of ${needed}. Copy it again.`);
        const values = packetSamples * stream.channels;
        if (values * needed > MAX_SAMPLES)
            throw new Problem("The stream is too long for this page. Use `vibrocast decode`.");
        const integers = new Int16Array(values * needed);
        const longest = stream.packets.reduce((most, packet) => Math.max(most, packet.length), 0);
        const samplesAt = (packetAt + longest + 7) & ~7;
        this.grow(samplesAt + 2 * values);
        stream.packets.forEach((packet, index) => {
            this.memory().set(packet, packetAt);
            this.check(this.functions.decode_packet(packetAt, packet.length, samplesAt));
            integers.set(new Int16Array(this.functions.memory.buffer, samplesAt, values), index * values);
        });
        return { integers, packetSamples, delaySamples, samples };
    }
}

/**
 * Returns each channel of a stream in its physical unit, without the codec's delay.
 * @param {Stream} stream
 * @param {Decoded} decoded
 * @returns {Float64Array[]}
 */
function channelsOf(stream, decoded) {
    return stream.gains.map((gain, channel) =>
        Float64Array.from(
            { length: decoded.samples },
            (_, index) => decoded.integers[(decoded.delaySamples + index) * stream.channels + channel] * (gain / 32768),
        ),
    );
}

/**
 * Returns the mean SNR in dB of the channels that are not silent; null where all are.
 * @param {ArrayLike<number>[]} reference
 * @param {ArrayLike<number>[]} decoded
 * @returns {number | null}
 */
function snrDb(reference, decoded) {
    const ratios = [];
    for (const [channel, samples] of reference.entries()) {
        let energy = 0;
        let noise = 0;
        for (let index = 0; index < samples.length; index++) {
            energy += samples[index] ** 2;
            noise += (samples[index] - decoded[channel][index]) ** 2;
        }
        if (energy > 0) ratios.push(10 * Math.log10(energy / noise));
    }
    return ratios.length === 0 ? null : ratios.reduce((sum, ratio) => sum + ratio, 0) / ratios.length;
}

const RESAMPLER_ZEROS = 16;

/**
 * Returns samples at another rate, by interpolation with a windowed sine cardinal. All content stays below the lower
 * of the two rates' halves.
 * @param {Float64Array} samples
 * @param {number} fromHz
 * @param {number} toHz
 * @returns {Float32Array}
 */
function resampled(samples, fromHz, toHz) {
    const band = Math.min(1, toHz / fromHz);
    const half = RESAMPLER_ZEROS / band;
    return Float32Array.from({ length: Math.ceil((samples.length * toHz) / fromHz) }, (_, index) => {
        const at = (index * fromHz) / toHz;
        const end = Math.min(samples.length - 1, Math.floor(at + half));
        let sum = 0;
        for (let tap = Math.max(0, Math.ceil(at - half)); tap <= end; tap++) {
            const x = Math.PI * (tap - at);
            const weight = x === 0 ? 1 : Math.sin(x * band) / (x * band);
            sum += samples[tap] * weight * (0.5 + 0.5 * Math.cos(x / half));
        }
        return sum * band;
    });
}

// ---- controllers ----

const BAUD = 921600;
const ANSWER_TIMEOUT_MS = 100;
const TRIES = 20;
const HELLO_TRIES = 5;
const MAX_SEQUENCE = 0xffff;
const MAX_FRAME_BYTES = 4096 + 2 + 17; // payload and CRC in COBS
const PREBUFFER_S = 1;
const READ_BACK_MS = 60000;

/**
 * What a controller needs of a port of WebSerial.
 * @typedef {{ open(options: { baudRate: number, bufferSize?: number }): Promise<void>, close(): Promise<void>,
 *     readable: ReadableStream<Uint8Array> | null, writable: WritableStream<Uint8Array> | null }} Port
 */

const GONE = "The controller is gone: its cable was pulled, or it lost power. Plug it in, and connect again.";

/** A session with a controller; docs/reference/protocol.md states the rules. */
class Controller {
    /**
     * Opens a port, and says Hello.
     * @param {Port} port
     * @param {Core} core
     * @returns {Promise<Controller>}
     */
    static async connect(port, core) {
        try {
            await port.open({ baudRate: BAUD, bufferSize: 65536 });
        } catch (error) {
            throw new Problem(
                `The port cannot be opened: ${error instanceof Error ? error.message : error} Close other programs that use it, and connect again.`,
            );
        }
        const controller = new Controller(port, core);
        try {
            await controller.hello();
        } catch (error) {
            await controller.close();
            throw error;
        }
        return controller;
    }

    /** @param {Port} port - An open one. @param {Core} core */
    constructor(port, core) {
        /** @type {HelloResponseMessage | null} */
        this.description = null;
        /** @type {StatusMessage | null} */
        this.status = null;
        /** @type {Problem | null} */
        this.lost = null;
        this.port = port;
        this.core = core;
        this.writer = /** @type {WritableStream<Uint8Array>} */ (port.writable).getWriter();
        /** @type {ReadableStreamDefaultReader<Uint8Array> | null} */
        this.reader = null;
        this.sequence = 0;
        this.sentMs = 0;
        this.closing = false;
        /** @type {{ name: keyof Messages, values: any } | null} */
        this.answer = null;
        /** @type {Problem | null} */
        this.complaint = null;
        /** @type {() => void} */
        this.wake = () => {};
        /** @type {Promise<unknown>} */
        this.turn = Promise.resolve();
        this.receiving = this.receive();
    }

    /** Ends the session, and frees the port. */
    async close() {
        this.closing = true;
        // A port that is gone fails each of these.
        await this.reader?.cancel().catch(() => {});
        await this.receiving;
        await this.writer.close().catch(() => {});
        await this.port.close().catch(() => {});
    }

    /** Takes in bytes until the port is closed or gone. */
    async receive() {
        while (this.port.readable && !this.closing) {
            const reader = (this.reader = this.port.readable.getReader());
            /** @type {number[]} */
            let frame = [];
            try {
                for (let read = await reader.read(); !read.done; read = await reader.read())
                    for (const byte of read.value)
                        if (byte !== 0) frame.push(byte);
                        else {
                            if (frame.length > 0 && frame.length <= MAX_FRAME_BYTES) this.take(Uint8Array.from(frame));
                            frame = [];
                        }
                break; // closed
            } catch {
                // After lost bytes, the port has another stream. Without one, it is gone.
            } finally {
                reader.releaseLock();
            }
        }
        if (!this.closing) this.lost = new Problem(GONE);
        this.wake();
    }

    /** @param {Uint8Array} frame - Without its delimiter. */
    take(frame) {
        const payload = this.core.payload(frame);
        const message = payload && unpackMessage(payload);
        if (!message) return; // damaged, or of a later minor version
        const { name, values, sequence } = message;
        if (name === "Status" && (sequence === 0 || sequence === this.sequence)) this.status = values;
        if (sequence === this.sequence && sequence !== 0) this.answer = { name, values };
        else if (sequence === 0 && name === "Error") this.complaint = rejection(values);
        this.wake();
    }

    /** @param {Uint8Array} bytes */
    async write(bytes) {
        if (this.lost) throw this.lost;
        this.sentMs = performance.now();
        try {
            await this.writer.write(bytes);
        } catch {
            throw new Problem(GONE);
        }
    }

    /** Waits for the next message, at most some time. @param {number} ms */
    async news(ms) {
        /** @type {ReturnType<typeof setTimeout> | undefined} */
        let timer;
        await new Promise((resolve) => {
            this.wake = () => resolve(undefined);
            timer = setTimeout(resolve, ms);
        });
        clearTimeout(timer);
        if (this.lost) throw this.lost;
    }

    /**
     * Sends a request, as often as it takes, and returns its answer. One request is under way at a time.
     * @template {keyof Messages} K
     * @template {keyof Messages} A
     * @param {K} name
     * @param {Messages[K]} values
     * @param {A} answer - The message that answers it.
     * @param {number} [tries]
     * @returns {Promise<Messages[A]>}
     */
    request(name, values, answer, tries = TRIES) {
        const asked = this.turn.then(() => this.ask(name, values, answer, tries));
        this.turn = asked.catch(() => {});
        return asked;
    }

    /**
     * @template {keyof Messages} K
     * @template {keyof Messages} A
     * @param {K} name
     * @param {Messages[K]} values
     * @param {A} answer
     * @param {number} tries
     * @returns {Promise<Messages[A]>}
     */
    async ask(name, values, answer, tries) {
        this.sequence = (this.sequence % MAX_SEQUENCE) + 1;
        this.answer = null;
        const frame = this.core.frame(packMessage(name, values, this.sequence));
        for (let tried = 0; tried < tries; tried++) {
            await this.write(frame);
            const until = performance.now() + ANSWER_TIMEOUT_MS;
            for (let left = ANSWER_TIMEOUT_MS; left > 0 && !this.answer; left = until - performance.now())
                await this.news(left);
            const found = /** @type {{ name: string, values: any } | null} */ (this.answer);
            if (found?.name === "Error") throw rejection(found.values);
            if (found?.name === answer) return found.values;
            if (found) throw new Problem(`The controller answers ${name} with ${found.name}. Update its firmware.`);
        }
        throw new Problem(
            "The controller does not answer: it has no power, or this is another device. Check it, and choose its port again.",
        );
    }

    /** Opens a session, and sets `description`. */
    async hello() {
        await this.write(Uint8Array.of(0)); // ends any noise on the link
        for (let left = TRIES; this.description === null; left -= HELLO_TRIES) {
            this.sequence = Math.floor(Math.random() * MAX_SEQUENCE);
            try {
                const hello = { major: PROTOCOL_MAJOR, minor: PROTOCOL_MINOR };
                this.description = await this.request("Hello", hello, "HelloResponse", HELLO_TRIES);
            } catch (error) {
                if (this.lost || left <= HELLO_TRIES) throw error;
            }
        }
        const { major, minor } = this.description;
        if (major !== PROTOCOL_MAJOR)
            throw new Problem(
                `The controller speaks protocol ${major}.${minor}, and this page ${PROTOCOL_MAJOR}.${PROTOCOL_MINOR}. Update the older one.`,
            );
    }

    /**
     * Plays a stream once, to its end or to a Stop. Stops the controller where it fails.
     * @param {Stream} stream
     * @param {Decoded} decoded
     * @param {(status: StatusMessage) => void} [tell] - Called with each Status.
     * @returns {Promise<StatusMessage>} the last one
     */
    async play(stream, decoded, tell = () => {}) {
        try {
            return await this.send(stream, decoded, tell);
        } catch (error) {
            if (!this.lost) await this.stop().catch(() => {});
            throw error;
        }
    }

    /**
     * Configures the controller, and sends packets as far as it grants credit.
     * @param {Stream} stream
     * @param {Decoded} decoded
     * @param {(status: StatusMessage) => void} tell
     * @returns {Promise<StatusMessage>}
     */
    async send(stream, decoded, tell) {
        const { limits } = /** @type {HelloResponseMessage} */ (this.description);
        const { packets } = stream;
        const { packetSamples } = decoded;
        const longest = packets.reduce((most, packet) => Math.max(most, packet.length), 0);
        if (longest > Math.min(limits.max_packet_bytes, limits.max_payload_bytes - PACKET_OVERHEAD_BYTES))
            throw new Problem(
                `A packet has ${longest} bytes, which the controller cannot hold. Use \`vibrocast play\`, which splits it.`,
            );
        const before = await this.request("StatusRequest", {}, "Status");
        const number = (before.stream + 1) % 256;
        const room = Math.floor(limits.buffer_samples / packetSamples);
        const ahead = Math.max(2, Math.ceil((PREBUFFER_S * stream.rateHz) / packetSamples));
        this.complaint = null;
        let status = await this.request(
            "Configure",
            {
                stream: number,
                compensation: 1,
                header: stream.header,
                gain: 1,
                loops: 1,
                first_packet: 0,
                packets: packets.length,
                prebuffer_samples: Math.min(room, ahead) * packetSamples,
            },
            "Status",
        );
        let credit = status.credit_until;
        status = await this.request("Start", { device_time_us: 0 }, "Status");
        for (let next = 0; ;) {
            if (this.complaint) throw this.complaint;
            if (this.status && this.status.stream === number) status = this.status;
            credit = Math.max(credit, status.credit_until);
            tell(status);
            if (status.state === STATES.FINISHED || status.state === STATES.STOPPED) return status;
            if (status.state === STATES.WATCHDOG)
                throw new Problem(
                    `The controller stopped, because it heard nothing for ${limits.watchdog_ms} ms. Keep this page in view, and play again.`,
                );
            if (status.state === STATES.FAULT)
                throw new Problem(
                    "The controller reports a fault of its hardware, and has stopped. Switch it off and on.",
                );
            const granted = Math.min(packets.length, Math.floor(credit / packetSamples));
            while (next < granted) {
                const chosen = this.fitting(packets.slice(next, granted), limits.max_payload_bytes);
                await this.write(
                    this.core.frame(packMessage("StreamData", { stream: number, iteration: 0, packets: chosen })),
                );
                next += chosen.length;
            }
            const silence = limits.watchdog_ms / 4 - (performance.now() - this.sentMs);
            if (silence <= 0) await this.request("StatusRequest", {}, "Status");
            else await this.news(Math.min(silence, ANSWER_TIMEOUT_MS));
        }
    }

    /** @param {Uint8Array[]} packets @param {number} payloadBytes @returns {Uint8Array[]} as many as one frame holds */
    fitting(packets, payloadBytes) {
        let left = payloadBytes - STREAM_DATA_HEAD_BYTES;
        const surplus = packets.findIndex(
            (packet) => (left -= packet.length + PACKET_OVERHEAD_BYTES - STREAM_DATA_HEAD_BYTES) < 0,
        );
        return surplus < 0 ? packets : packets.slice(0, surplus);
    }

    /** Ramps the output down at once, also in the middle of a playback. */
    async stop() {
        await this.write(Uint8Array.of(0));
        await this.request("Stop", {}, "Status");
    }

    /**
     * Reads back the samples that the controller decoded.
     * @param {number} channels
     * @returns {Promise<Int16Array | null>} interleaved; null where it does not keep them all
     */
    async decodedSamples(channels) {
        const { limits } = /** @type {HelloResponseMessage} */ (this.description);
        const head = packMessage("CaptureData", { tap: 0, channels, offset: 0, end: 0, data: new Uint8Array() });
        const count = Math.floor((limits.max_payload_bytes - head.length) / (2 * channels));
        const until = performance.now() + READ_BACK_MS;
        /** @type {number[]} */
        const samples = [];
        for (let end = 1; limits.capture_samples > 0 && samples.length < end * channels;) {
            const offset = samples.length / channels;
            const answer = await this.request("CaptureRead", { tap: TAPS.DECODED, offset, count }, "CaptureData");
            if (answer.offset !== offset || performance.now() > until) return null;
            if (answer.data.length === 0) break;
            const reader = new Reader(answer.data, () => new RangeError("half a sample"));
            while (reader.left > 1) samples.push((reader.number("u16") << 16) >> 16);
            end = answer.end;
        }
        return limits.capture_samples > 0 ? Int16Array.from(samples) : null;
    }
}

/** @param {ErrorMessage} error @returns {Problem} */
function rejection({ code, text }) {
    if (code === ERROR_CODES.HELLO_FIRST)
        return new Problem("The controller has restarted, which ends the session. Connect again.");
    return new Problem(`The controller rejects the request: ${text || `error ${code}`}.`);
}
