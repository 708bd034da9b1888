// The player of docs/tutorials/browser.md: shows a stream, and plays it on a sound card or on a controller.
"use strict";

/**
 * What studies/browser_page.py writes; bytes are in base64. `original`: float32, channels interleaved.
 * @typedef {{ core: string, codecs: Record<number, string>,
 *     examples: { name: string, title: string, original: string, streams: string[] }[] }} PlayerData
 */

const FADE_S = 0.05;
const START_LEVEL_DB = -30;
const SILENT_LEVEL_DB = -60;
const STRONGEST_S = 0.06;
const SPECTRUM_FRAME = 512;
const SPECTRUM_FRAMES = 64;
const SPECTRUM_RANGE_DB = 60;
const CARD_CHANNELS = 32;
const MAX_FILE_BYTES = 2 ** 26;

/** @param {string} text @returns {Uint8Array<ArrayBuffer>} */
function fromBase64(text) {
    return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

/**
 * Returns the mean power of each frequency from 0 to half the rate, over frames of SPECTRUM_FRAME samples.
 * @param {ArrayLike<number>} samples
 * @returns {Float64Array}
 */
function spectrum(samples) {
    const bins = SPECTRUM_FRAME / 2;
    const cosine = Float64Array.from({ length: SPECTRUM_FRAME }, (_, n) =>
        Math.cos((2 * Math.PI * n) / SPECTRUM_FRAME),
    );
    const power = new Float64Array(bins);
    const hop = Math.max(bins, Math.floor((samples.length - SPECTRUM_FRAME) / SPECTRUM_FRAMES));
    for (let start = 0; start === 0 || start + SPECTRUM_FRAME <= samples.length; start += hop)
        for (let bin = 0; bin < bins; bin++) {
            let real = 0;
            let imaginary = 0;
            for (let n = 0; n < SPECTRUM_FRAME; n++) {
                const value = (samples[start + n] ?? 0) * (0.5 - 0.5 * cosine[n]);
                real += value * cosine[(n * bin) % SPECTRUM_FRAME];
                imaginary += value * cosine[(n * bin + SPECTRUM_FRAME / 4) % SPECTRUM_FRAME];
            }
            power[bin] += real ** 2 + imaginary ** 2;
        }
    return power;
}

/** @param {Element} place @param {string} text - With names between backticks, which become code. */
function showText(place, text) {
    const parts = text.split("`").map((part, index) => {
        const node = index % 2 ? document.createElement("code") : document.createElement("span");
        node.textContent = part;
        return node;
    });
    place.replaceChildren(...parts);
}

// ---- charts ----

/** @typedef {{ name: string, points: [number, number][] }} Curve - Names "original" and "decoded" have their looks. */

/**
 * @param {string} name
 * @param {Record<string, string | number>} attributes
 * @param {string} [text]
 */
function svg(name, attributes, text) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
    if (text !== undefined) made.textContent = text;
    return made;
}

/** @param {number} value */
function short(value) {
    return String(Number(value.toPrecision(2)));
}

/**
 * Draws curves into an element, as wide as it is.
 * @param {Element} place
 * @param {Curve[]} curves
 * @param {[number, number]} xs - Ends of the axis.
 * @param {[number, number]} ys
 * @param {string} unit - Of the horizontal axis.
 */
function draw(place, curves, xs, ys, unit) {
    const [width, height, left, bottom] = [Math.max(240, place.clientWidth), 170, 46, 26];
    /** @param {number} value */
    const x = (value) => left + ((value - xs[0]) / (xs[1] - xs[0])) * (width - left - 8);
    /** @param {number} value */
    const y = (value) => 8 + ((ys[1] - value) / (ys[1] - ys[0])) * (height - bottom - 8);
    const picture = svg("svg", { width, height, "aria-hidden": "true" });
    for (const part of [0, 0.5, 1]) {
        const [column, row] = [xs[0] + part * (xs[1] - xs[0]), ys[0] + part * (ys[1] - ys[0])];
        picture.append(
            svg("line", { class: "vc-grid", x1: left, x2: width - 8, y1: y(row), y2: y(row) }),
            svg("text", { x: left - 6, y: y(row) + 4, "text-anchor": "end" }, short(row)),
            svg(
                "text",
                { x: x(column), y: height - 6, "text-anchor": ["start", "middle", "end"][2 * part] },
                part === 1 ? `${short(column)} ${unit}` : short(column),
            ),
        );
    }
    for (const { name, points } of curves)
        picture.append(
            svg("polyline", {
                class: `vc-curve vc-${name}`,
                points: points
                    .map(([a, b]) => `${x(a).toFixed(1)},${y(Math.min(ys[1], Math.max(ys[0], b))).toFixed(1)}`)
                    .join(" "),
            }),
        );
    place.replaceChildren(picture);
}

/**
 * Returns the points of samples: all, or the least and the greatest of each of many stretches.
 * @param {ArrayLike<number>} samples
 * @param {number} rateHz
 * @returns {[number, number][]}
 */
function points(samples, rateHz) {
    const stretch = Math.max(1, Math.floor(samples.length / 600));
    /** @type {[number, number][]} */
    const found = [];
    for (let at = 0; at < samples.length; at += stretch) {
        let low = samples[at];
        let high = samples[at];
        for (let index = at; index < Math.min(samples.length, at + stretch); index++) {
            low = Math.min(low, samples[index]);
            high = Math.max(high, samples[index]);
        }
        found.push([at / rateHz, low]);
        if (stretch > 1) found.push([at / rateHz, high]);
    }
    return found;
}

/** @param {ArrayLike<number>} samples */
function peakOf(samples) {
    let peak = 0;
    for (let index = 0; index < samples.length; index++) peak = Math.max(peak, Math.abs(samples[index]));
    return peak;
}

// ---- the page ----

/** The page: its controls, the stream that is shown, and what plays it. */
class Player {
    /** @param {Element} root @param {PlayerData} data @param {Core} core */
    constructor(root, data, core) {
        this.root = root;
        this.data = data;
        this.core = core;
        /** @type {{ stream: Stream, decoded: Decoded, channels: Float64Array[], original: Float64Array[] | null } | null} */
        this.shown = null;
        /** @type {{ context: AudioContext, source: AudioBufferSourceNode, fade: GainNode, level: GainNode } | null} */
        this.sound = null;
        /** @type {Controller | null} */
        this.controller = null;
        /** @type {HTMLSelectElement} */
        this.example = this.get("example");
        /** @type {HTMLInputElement} */
        this.rate = this.get("rate");
        /** @type {HTMLInputElement} */
        this.file = this.get("file");
        /** @type {HTMLInputElement} */
        this.level = this.get("level");
        this.example.append(...data.examples.map(({ title }) => new Option(title)));
        this.level.min = String(SILENT_LEVEL_DB);
        this.level.value = String(START_LEVEL_DB);
        this.own = new Option("Your file", "file");
        this.own.disabled = true; // shown, not chosen
        this.example.append(this.own);
        this.on("example", "change", () => this.showExample());
        this.on("file", "click", () => (this.file.value = "")); // so that the same file can be chosen again
        this.on("rate", "input", () => this.showExample());
        this.on("file", "change", () => this.showFiles());
        this.on("level", "input", () => this.setLevel());
        this.on("play", "click", () => this.playSound());
        this.on("stop", "click", () => this.stopSound());
        this.on("connect", "click", () => this.connect());
        this.on("disconnect", "click", () => this.disconnect());
        this.on("send", "click", () => this.playOnController());
        this.on("halt", "click", () => this.controller?.stop());
        new ResizeObserver(() => this.drawAll()).observe(this.get("wave"));
        this.setLevel();
        this.enable();
        this.run(() => this.showExample());
    }

    /** @param {string} name @returns {any} the element of the page with that name */
    get(name) {
        return this.root.querySelector(`[data-vc="${name}"]`);
    }

    /** @param {string} name @param {string} event @param {() => unknown} action */
    on(name, event, action) {
        this.get(name).addEventListener(event, () => this.run(action));
    }

    /** Carries out an action; shows what went wrong. @param {() => unknown} action */
    async run(action) {
        this.get("problem").replaceChildren();
        try {
            await action();
        } catch (error) {
            const text =
                error instanceof Problem ? error.message : `The page failed: ${error}. Load it again, and report this.`;
            showText(this.get("problem"), text);
        }
        this.enable();
    }

    /** @param {string} name @param {string} text */
    say(name, text) {
        showText(this.get(name), text);
    }

    /** Enables the buttons that can do something. */
    enable() {
        const temporal = this.shown !== null && this.shown.stream.unit !== PROFILE_UNIT;
        this.get("play").disabled = !temporal || this.sound !== null;
        this.get("stop").disabled = this.sound === null;
        this.get("connect").disabled = this.controller !== null;
        this.get("disconnect").disabled = this.controller === null || this.sending;
        this.get("send").disabled = !temporal || this.controller === null || this.sending;
        this.get("halt").disabled = !this.sending;
        this.rate.disabled = this.example.value === "file";
    }

    sending = false;

    // ---- what is shown ----

    showExample() {
        this.file.value = "";
        const { original, streams } = this.data.examples[this.example.selectedIndex];
        this.rate.max = String(streams.length - 1);
        const floats = new Float32Array(fromBase64(original).buffer);
        this.show(fromBase64(streams[Number(this.rate.value)]), undefined, floats);
    }

    async showFiles() {
        const files = [...(this.file.files ?? [])];
        if (files.length === 0) return;
        const streams = files.filter(({ name }) => !name.endsWith(".vcmi"));
        const images = files.filter(({ name }) => name.endsWith(".vcmi"));
        if (streams.length !== 1 || images.length > 1)
            throw new Problem(
                "The choice is not clear: it needs one .vct file, and at most one .vcmi file with its model. Choose again.",
            );
        if (streams[0].size > MAX_FILE_BYTES)
            throw new Problem("The file is too large for this page. Use `vibrocast decode`.");
        const [file, image] = await Promise.all(
            [streams[0], ...images].map(async (each) => new Uint8Array(await each.arrayBuffer())),
        );
        this.show(file, image);
        this.example.value = "file";
    }

    /**
     * Decodes a file and shows it. What was shown before stays, if that fails.
     * @param {Uint8Array} file
     * @param {Uint8Array} [image]
     * @param {Float32Array} [original]
     */
    show(file, image, original) {
        const stream = this.core.read(file);
        const decoded = this.core.decode(stream, image);
        const channels = channelsOf(stream, decoded);
        const split =
            original &&
            channels.map((_, channel) =>
                Float64Array.from(
                    { length: decoded.samples },
                    (__, index) => original[index * channels.length + channel],
                ),
            );
        this.shown = { stream, decoded, channels, original: split ?? null };
        const seconds = decoded.samples / stream.rateHz;
        const ratio = split ? snrDb(split, channels) : null;
        const spatial = stream.unit === PROFILE_UNIT;
        const bits = (8 * stream.fileBytes) / seconds;
        this.say("bits", spatial ? `${(bits / 1000).toFixed(1)} bit/mm` : `${bits.toFixed(0)} bit/s`);
        this.say(
            "snr",
            split === undefined
                ? "unknown: no original here"
                : ratio === null
                  ? "none: silence"
                  : `${ratio.toFixed(2)} dB`,
        );
        this.say(
            "size",
            `${stream.fileBytes} bytes in ${stream.packets.length} packet(s), 1/${((2 * channels.length * decoded.samples) / stream.fileBytes).toFixed(0)} of 16-bit samples`,
        );
        this.say("codec", this.data.codecs[stream.codec]);
        this.say(
            "signal",
            spatial
                ? `${(1000 * seconds).toFixed(2)} mm, ${channels.length} channel(s): a height profile, which a hand plays by \`vibrocast play\``
                : `${seconds.toFixed(2)} s, ${channels.length} channel(s) at ${stream.rateHz} Hz, unit ${UNITS[stream.unit]}`,
        );
        this.drawAll();
        this.enable();
    }

    drawAll() {
        if (this.shown === null) return;
        const { stream, channels, original } = this.shown;
        const { rateHz } = stream;
        const sources = /** @type {[string, Float64Array][]} */ ([
            ["original", original?.[0]],
            ["decoded", channels[0]],
        ]).filter(([, samples]) => samples);
        const peak = Math.max(...sources.map(([, samples]) => peakOf(samples))) || 1;
        const [decoded] = channels;
        const highest = peakOf(decoded);
        const strongest = decoded.findIndex((value) => Math.abs(value) === highest);
        const width = Math.min(decoded.length, Math.ceil(STRONGEST_S * rateHz));
        const start = Math.max(0, Math.min(decoded.length - width, strongest - Math.floor(width / 2)));
        const [along, across] = stream.unit === PROFILE_UNIT ? ["m", "1/m"] : ["s", "Hz"];
        this.say("unit", UNITS[stream.unit].split(" over")[0]);
        for (const [place, from, to] of /** @type {const} */ ([
            ["wave", 0, decoded.length],
            ["strongest", start, start + width],
        ])) {
            const curves = sources.map(([name, samples]) => ({
                name,
                points: points(samples.subarray(from, to), rateHz),
            }));
            const scale = place === "wave" ? 1 : 1000; // m or s, mm or ms
            for (const curve of curves) for (const point of curve.points) point[0] *= scale;
            draw(
                this.get(place),
                curves,
                [0, (scale * (to - from)) / rateHz],
                [-peak, peak],
                scale === 1 ? along : `m${along}`,
            );
        }
        const powers = sources.map(([name, samples]) => /** @type {const} */ ([name, spectrum(samples)]));
        const most = Math.max(...powers.map(([, power]) => peakOf(power))) || 1;
        const spectra = powers.map(([name, power]) => ({
            name,
            points: Array.from(
                power,
                (value, bin) =>
                    /** @type {[number, number]} */ ([
                        (bin * rateHz) / SPECTRUM_FRAME,
                        10 * Math.log10(value / most + 1e-12),
                    ]),
            ),
        }));
        draw(this.get("spectrum"), spectra, [0, rateHz / 2], [-SPECTRUM_RANGE_DB, 0], across);
    }

    // ---- sound card ----

    /** @returns {number} the factor of the chosen level */
    gain() {
        const level = Number(this.level.value);
        return level <= SILENT_LEVEL_DB ? 0 : 10 ** (level / 20);
    }

    setLevel() {
        this.say("level-text", this.gain() === 0 ? "silent" : `${this.level.value} dB`);
        if (this.sound) this.sound.level.gain.setTargetAtTime(this.gain(), this.sound.context.currentTime, FADE_S / 3);
    }

    async playSound() {
        if (this.shown === null || this.sound !== null) return;
        if (!("AudioContext" in window))
            throw new Problem("This browser has no WebAudio, so it cannot play. Use a current browser.");
        const { stream, channels } = this.shown;
        const context = new AudioContext();
        const buffer = context.createBuffer(
            Math.min(channels.length, CARD_CHANNELS),
            Math.ceil((channels[0].length * context.sampleRate) / stream.rateHz),
            context.sampleRate,
        );
        // Full scale of the loudest channel is full scale of the card at 0 dB.
        const fullScale = Math.max(...stream.gains);
        for (let channel = 0; channel < buffer.numberOfChannels; channel++)
            buffer.getChannelData(channel).set(
                resampled(
                    channels[channel].map((value) => value / fullScale),
                    stream.rateHz,
                    context.sampleRate,
                ),
            );
        const [source, fade, level] = [context.createBufferSource(), context.createGain(), context.createGain()];
        source.buffer = buffer;
        context.destination.channelCount = Math.max(
            1,
            Math.min(context.destination.maxChannelCount, Math.max(2, buffer.numberOfChannels)),
        );
        level.gain.value = this.gain();
        source.connect(fade).connect(level).connect(context.destination);
        this.sound = { context, source, fade, level };
        await context.resume();
        const begin = context.currentTime + FADE_S;
        const end = begin + buffer.duration;
        fade.gain.setValueAtTime(0, begin);
        fade.gain.linearRampToValueAtTime(1, begin + FADE_S);
        fade.gain.setValueAtTime(1, Math.max(begin + FADE_S, end - FADE_S));
        fade.gain.linearRampToValueAtTime(0, end);
        source.start(begin);
        this.say("sound", "Playing.");
        source.onended = () => {
            this.sound = null;
            this.say("sound", "Played.");
            this.enable();
            void context.close();
        };
    }

    stopSound() {
        if (this.sound === null) return;
        const { context, source, fade } = this.sound;
        const now = context.currentTime;
        fade.gain.cancelScheduledValues(now);
        fade.gain.setValueAtTime(fade.gain.value, now);
        fade.gain.linearRampToValueAtTime(0, now + FADE_S);
        source.stop(now + FADE_S);
    }

    // ---- controller ----

    async connect() {
        const { serial } = /** @type {{ serial?: { requestPort(): Promise<Port> } }} */ (
            /** @type {unknown} */ (navigator)
        );
        if (serial === undefined)
            throw new Problem(
                "This browser has no WebSerial, so it cannot reach a controller. Use Chromium, Chrome or Edge on a computer, or `vibrocast play`.",
            );
        /** @type {Port} */
        let port;
        try {
            port = await serial.requestPort();
        } catch (error) {
            if (error instanceof DOMException && error.name === "NotFoundError")
                throw new Problem("No port was chosen. Plug the controller in, connect again, and choose its port.");
            throw error;
        }
        this.say("device", "Connecting.");
        try {
            this.controller = await Controller.connect(port, this.core);
        } catch (error) {
            this.say("device", "Not connected.");
            throw error;
        }
        const description = /** @type {HelloResponseMessage} */ (this.controller.description);
        this.say(
            "device",
            `Connected to ${description.hardware}, ${description.build}, with ${description.actuator.name}.`,
        );
        this.controller.receiving.then(() => this.run(() => this.disconnect()));
    }

    /** Ends the session with a controller, also with one that is gone. */
    async disconnect() {
        const { controller } = this;
        if (controller === null) return;
        this.controller = null;
        this.say("device", "Not connected.");
        await controller.close();
        if (controller.lost) throw controller.lost;
    }

    async playOnController() {
        const { controller, shown } = this;
        if (controller === null || shown === null || this.sending) return;
        this.sending = true;
        this.enable();
        try {
            const { stream, decoded } = shown;
            const names = Object.keys(STATES);
            const last = await controller.play(stream, decoded, (status) => {
                const [played, buffered] = [status.position, status.buffered_samples].map((count) =>
                    (count / stream.rateHz).toFixed(2),
                );
                this.say(
                    "device",
                    `${names[status.state].toLowerCase()}: ${played} s, ${buffered} s buffered, ${status.underruns} underrun(s), ${status.lost_packets} lost packet(s)`,
                );
            });
            if (last.state === STATES.STOPPED) return this.say("device", "Stopped.");
            const there = await controller.decodedSamples(stream.channels);
            const here = decoded.integers;
            const compared =
                there === null
                    ? "It does not keep the samples, so nothing was compared."
                    : there.length === here.length && there.every((value, index) => value === here[index])
                      ? `All ${there.length} samples are equal to those decoded here.`
                      : "Its samples differ from those decoded here: report this, with the stream and the firmware.";
            this.say(
                "device",
                `Played, ${last.underruns} underrun(s), ${last.lost_packets} lost packet(s). ${compared}`,
            );
        } finally {
            this.sending = false;
        }
    }
}

/** @returns {Promise<Player>} */
async function startPlayer() {
    const root = /** @type {Element} */ (document.querySelector("[data-vc=root]"));
    try {
        // @ts-ignore - player_data.js, which the site's build writes, declares it.
        const data = /** @type {PlayerData} */ (PLAYER_DATA);
        return new Player(root, data, await Core.load(fromBase64(data.core)));
    } catch (error) {
        const problem = /** @type {Element} */ (root.querySelector("[data-vc=problem]"));
        showText(
            problem,
            `The page cannot start: ${error}. Build the site with \`make docs\`, and use a current browser.`,
        );
        throw error;
    }
}

const player = startPlayer();
