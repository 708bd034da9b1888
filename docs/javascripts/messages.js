// Layouts of the messages of vibrocast's protocol; written by device_protocol/generate.py, read by vibrocast.js.
"use strict";

const PROTOCOL_MAJOR = 2;
const PROTOCOL_MINOR = 2;
const FIRST_UNSEQUENCED = 0x40;
const FIRST_FROM_CONTROLLER = 0x80;
const STREAM_DATA_HEAD_BYTES = 7;
const PACKET_OVERHEAD_BYTES = 12;

const ERROR_CODES = { UNKNOWN_MESSAGE: 1, MALFORMED: 2, UNSUPPORTED_VERSION: 3, HELLO_FIRST: 4, WRONG_STATE: 5, BAD_VALUE: 6, UNKNOWN_CODEC: 7, UNKNOWN_IMAGE: 8, BEYOND_LIMITS: 9, NO_SUCH_SLOT: 10, WRONG_HARDWARE: 11, IMAGE_REJECTED: 12, FLASH_FAILED: 13 };
const STATES = { IDLE: 0, BUFFERING: 1, ARMED: 2, PLAYING: 3, PAUSED: 4, FINISHED: 5, STOPPED: 6, WATCHDOG: 7, FAULT: 8 };
const TAPS = { DECODED: 0, DAC: 1 };

/** @typedef {{ max_payload_bytes: number, max_packet_bytes: number, buffer_samples: number, capture_samples: number, channels: number, min_rate_hz: number, max_rate_hz: number, watchdog_ms: number, profile_samples: number, packet_samples: number, decoding_kilocycles_per_s: number }} Limits */
/** @typedef {{ stroke_um: number, volts: number, lower_hz: number, upper_hz: number, slew_volts_per_second: number, dac_bits: number, dac_rate_hz: number, name: string }} ActuatorDescription */
/** @typedef {{ identifier: number, name: string }} CodecDescription */
/** @typedef {{ slot: number, state: number, sha256: Uint8Array, number: number, name: string, version: string }} ImageDescription */
/** @typedef {{ packet_samples: number, delay_samples: number }} CodingDescription */
/** @typedef {{ stream: number, credit_until: number }} QueuedStream */
/** @typedef {{ refused: number, restarts: number }} OutputFaults */
/** @typedef {{ repeated: number, reordered: number }} FrameFaults */
/** @typedef {{ major: number, minor: number }} HelloMessage */
/** @typedef {{ }} StatusRequestMessage */
/** @typedef {{ stream: number, compensation: number, prebuffer_samples: number, packets: number, first_packet: number, loops: number, gain: number, header: Uint8Array }} ConfigureMessage */
/** @typedef {{ stream: number, compensation: number, prebuffer_samples: number, packets: number, first_packet: number, loops: number, gain: number, header: Uint8Array }} QueueMessage */
/** @typedef {{ device_time_us: number }} StartMessage */
/** @typedef {{ }} PauseMessage */
/** @typedef {{ }} ResumeMessage */
/** @typedef {{ }} StopMessage */
/** @typedef {{ loops: number }} LoopMessage */
/** @typedef {{ gain: number }} GainMessage */
/** @typedef {{ stream: number, packets: number }} EndStreamMessage */
/** @typedef {{ tap: number, offset: number, count: number }} CaptureReadMessage */
/** @typedef {{ slot: number, size_bytes: number, sha256: Uint8Array, hardware: string }} FlashBeginMessage */
/** @typedef {{ slot: number, offset: number, data: Uint8Array }} FlashDataMessage */
/** @typedef {{ slot: number }} FlashVerifyMessage */
/** @typedef {{ slot: number }} FlashActivateMessage */
/** @typedef {{ slot: number }} FlashConfirmMessage */
/** @typedef {{ slot: number }} FlashEraseMessage */
/** @typedef {{ slot: number, offset: number, count: number }} FlashReadMessage */
/** @typedef {{ stream: number, iteration: number, packets: Uint8Array[] }} StreamDataMessage */
/** @typedef {{ device_time_us: number, position_nm: number }} PositionMessage */
/** @typedef {{ stream: number, packet: Uint8Array }} SinglePacketMessage */
/** @typedef {{ major: number, minor: number, build: string, hardware: string, limits: Limits, actuator: ActuatorDescription, codecs: CodecDescription[], images: ImageDescription[], public_key: Uint8Array, serial_number: string }} HelloResponseMessage */
/** @typedef {{ state: number, stream: number, device_time_us: number, position: number, credit_until: number, buffered_samples: number, bad_frames: number, underruns: number, lost_packets: number, compensation_clipped: number, voltage_limited: number, slew_limited: number, power_limited: number, output_gaps: number, late_samples: number, signed_images: number, coding: CodingDescription | null, queued: QueuedStream | null, output_faults: OutputFaults | null, frame_faults: FrameFaults | null }} StatusMessage */
/** @typedef {{ tap: number, channels: number, offset: number, end: number, data: Uint8Array }} CaptureDataMessage */
/** @typedef {{ slot: number, state: number, next_offset: number, sha256: Uint8Array }} FlashStatusMessage */
/** @typedef {{ slot: number, size_bytes: number, offset: number, data: Uint8Array }} FlashContentsMessage */
/** @typedef {{ code: number, text: string }} ErrorMessage */
/** @typedef {{ Hello: HelloMessage, StatusRequest: StatusRequestMessage, Configure: ConfigureMessage, Queue: QueueMessage, Start: StartMessage, Pause: PauseMessage, Resume: ResumeMessage, Stop: StopMessage, Loop: LoopMessage, Gain: GainMessage, EndStream: EndStreamMessage, CaptureRead: CaptureReadMessage, FlashBegin: FlashBeginMessage, FlashData: FlashDataMessage, FlashVerify: FlashVerifyMessage, FlashActivate: FlashActivateMessage, FlashConfirm: FlashConfirmMessage, FlashErase: FlashEraseMessage, FlashRead: FlashReadMessage, StreamData: StreamDataMessage, Position: PositionMessage, SinglePacket: SinglePacketMessage, HelloResponse: HelloResponseMessage, Status: StatusMessage, CaptureData: CaptureDataMessage, FlashStatus: FlashStatusMessage, FlashContents: FlashContentsMessage, Error: ErrorMessage }} Messages */

/** @type {Record<string, Layout>} */
const LAYOUTS = {
    Limits: {
        type: null,
        fields: [["max_payload_bytes", "u16"], ["max_packet_bytes", "u16"], ["buffer_samples", "u32"], ["capture_samples", "u32"], ["channels", "u8"], ["min_rate_hz", "u32"], ["max_rate_hz", "u32"], ["watchdog_ms", "u16"], ["profile_samples", "u32"], ["packet_samples", "u32"], ["decoding_kilocycles_per_s", "u32"]],
        tags: { },
    },
    ActuatorDescription: {
        type: null,
        fields: [["stroke_um", "f32"], ["volts", "f32"], ["lower_hz", "f32"], ["upper_hz", "f32"], ["slew_volts_per_second", "f32"], ["dac_bits", "u8"], ["dac_rate_hz", "u32"], ["name", "text"]],
        tags: { },
    },
    CodecDescription: {
        type: null,
        fields: [["identifier", "u8"], ["name", "text"]],
        tags: { },
    },
    ImageDescription: {
        type: null,
        fields: [["slot", "u8"], ["state", "u8"], ["sha256", "32"], ["number", "u32"], ["name", "counted"], ["version", "text"]],
        tags: { },
    },
    CodingDescription: {
        type: null,
        fields: [["packet_samples", "u32"], ["delay_samples", "u32"]],
        tags: { },
    },
    QueuedStream: {
        type: null,
        fields: [["stream", "u8"], ["credit_until", "u64"]],
        tags: { },
    },
    OutputFaults: {
        type: null,
        fields: [["refused", "u32"], ["restarts", "u32"]],
        tags: { },
    },
    FrameFaults: {
        type: null,
        fields: [["repeated", "u32"], ["reordered", "u32"]],
        tags: { },
    },
    Hello: {
        type: 0x01,
        fields: [["major", "u8"], ["minor", "u8"]],
        tags: { },
    },
    StatusRequest: {
        type: 0x02,
        fields: [],
        tags: { },
    },
    Configure: {
        type: 0x03,
        fields: [["stream", "u8"], ["compensation", "u8"], ["prebuffer_samples", "u32"], ["packets", "u32"], ["first_packet", "u32"], ["loops", "u16"], ["gain", "f32"]],
        tags: { 1: { name: "header", kind: "bytes", list: false, optional: false } },
    },
    Queue: {
        type: 0x0c,
        fields: [["stream", "u8"], ["compensation", "u8"], ["prebuffer_samples", "u32"], ["packets", "u32"], ["first_packet", "u32"], ["loops", "u16"], ["gain", "f32"]],
        tags: { 1: { name: "header", kind: "bytes", list: false, optional: false } },
    },
    Start: {
        type: 0x04,
        fields: [["device_time_us", "u64"]],
        tags: { },
    },
    Pause: {
        type: 0x05,
        fields: [],
        tags: { },
    },
    Resume: {
        type: 0x06,
        fields: [],
        tags: { },
    },
    Stop: {
        type: 0x07,
        fields: [],
        tags: { },
    },
    Loop: {
        type: 0x08,
        fields: [["loops", "u16"]],
        tags: { },
    },
    Gain: {
        type: 0x09,
        fields: [["gain", "f32"]],
        tags: { },
    },
    EndStream: {
        type: 0x0a,
        fields: [["stream", "u8"], ["packets", "u32"]],
        tags: { },
    },
    CaptureRead: {
        type: 0x0b,
        fields: [["tap", "u8"], ["offset", "u64"], ["count", "u16"]],
        tags: { },
    },
    FlashBegin: {
        type: 0x10,
        fields: [["slot", "u8"], ["size_bytes", "u32"], ["sha256", "32"]],
        tags: { 1: { name: "hardware", kind: "text", list: false, optional: false } },
    },
    FlashData: {
        type: 0x11,
        fields: [["slot", "u8"], ["offset", "u32"], ["data", "bytes"]],
        tags: { },
    },
    FlashVerify: {
        type: 0x12,
        fields: [["slot", "u8"]],
        tags: { },
    },
    FlashActivate: {
        type: 0x13,
        fields: [["slot", "u8"]],
        tags: { },
    },
    FlashConfirm: {
        type: 0x14,
        fields: [["slot", "u8"]],
        tags: { },
    },
    FlashErase: {
        type: 0x15,
        fields: [["slot", "u8"]],
        tags: { },
    },
    FlashRead: {
        type: 0x16,
        fields: [["slot", "u8"], ["offset", "u32"], ["count", "u16"]],
        tags: { },
    },
    StreamData: {
        type: 0x40,
        fields: [["stream", "u8"], ["iteration", "varint"], ["packets", "items"]],
        tags: { },
    },
    Position: {
        type: 0x41,
        fields: [["device_time_us", "u64"], ["position_nm", "i64"]],
        tags: { },
    },
    SinglePacket: {
        type: 0x42,
        fields: [["stream", "u8"], ["packet", "bytes"]],
        tags: { },
    },
    HelloResponse: {
        type: 0x80,
        fields: [["major", "u8"], ["minor", "u8"]],
        tags: { 1: { name: "build", kind: "text", list: false, optional: false }, 2: { name: "hardware", kind: "text", list: false, optional: false }, 3: { name: "limits", kind: "Limits", list: false, optional: false }, 4: { name: "actuator", kind: "ActuatorDescription", list: false, optional: false }, 5: { name: "codecs", kind: "CodecDescription", list: true, optional: false }, 6: { name: "images", kind: "ImageDescription", list: true, optional: false }, 7: { name: "public_key", kind: "bytes", list: false, optional: false }, 8: { name: "serial_number", kind: "text", list: false, optional: false } },
    },
    Status: {
        type: 0x81,
        fields: [["state", "u8"], ["stream", "u8"], ["device_time_us", "u64"], ["position", "u64"], ["credit_until", "u64"], ["buffered_samples", "u32"], ["bad_frames", "u32"], ["underruns", "u32"], ["lost_packets", "u32"], ["compensation_clipped", "u32"], ["voltage_limited", "u32"], ["slew_limited", "u32"], ["power_limited", "u32"], ["output_gaps", "u32"], ["late_samples", "u32"], ["signed_images", "u8"]],
        tags: { 1: { name: "coding", kind: "CodingDescription", list: false, optional: true }, 2: { name: "queued", kind: "QueuedStream", list: false, optional: true }, 3: { name: "output_faults", kind: "OutputFaults", list: false, optional: true }, 4: { name: "frame_faults", kind: "FrameFaults", list: false, optional: true } },
    },
    CaptureData: {
        type: 0x82,
        fields: [["tap", "u8"], ["channels", "u8"], ["offset", "u64"], ["end", "u64"], ["data", "bytes"]],
        tags: { },
    },
    FlashStatus: {
        type: 0x83,
        fields: [["slot", "u8"], ["state", "u8"], ["next_offset", "u32"], ["sha256", "32"]],
        tags: { },
    },
    FlashContents: {
        type: 0x84,
        fields: [["slot", "u8"], ["size_bytes", "u32"], ["offset", "u32"], ["data", "bytes"]],
        tags: { },
    },
    Error: {
        type: 0xff,
        fields: [["code", "u16"]],
        tags: { 1: { name: "text", kind: "text", list: false, optional: false } },
    },
};
