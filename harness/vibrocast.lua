-- Wireshark's dissector of vibrocast's protocol. Written by harness/dissector.py.
--
-- A packet of a trace (link type USER0) is a frame without its delimiter: COBS(message, CRC-16).
-- tshark -X lua_script:vibrocast.lua -r trace.pcapng

local vibrocast = Proto("vibrocast", "vibrocast device protocol")
local fields = vibrocast.fields
local bad_frame = ProtoExpert.new("vibrocast.bad_frame", "damaged frame", expert.group.CHECKSUM, expert.severity.ERROR)
local cut_message = ProtoExpert.new("vibrocast.cut", "message is too short", expert.group.MALFORMED, expert.severity.ERROR)
vibrocast.experts = { bad_frame, cut_message }

fields.type = ProtoField.uint8("vibrocast.type", "type", base.HEX)
fields.sequence = ProtoField.uint16("vibrocast.sequence", "sequence")
fields.tag = ProtoField.uint8("vibrocast.tag", "tag", base.HEX)
fields.value = ProtoField.bytes("vibrocast.value", "value")
fields.hello_major = ProtoField.uint8("vibrocast.hello.major", "major")
fields.hello_minor = ProtoField.uint8("vibrocast.hello.minor", "minor")
fields.configure_stream = ProtoField.uint8("vibrocast.configure.stream", "stream")
fields.configure_compensation = ProtoField.uint8("vibrocast.configure.compensation", "compensation")
fields.configure_prebuffer_samples = ProtoField.uint32("vibrocast.configure.prebuffer_samples", "prebuffer_samples")
fields.configure_packets = ProtoField.uint32("vibrocast.configure.packets", "packets")
fields.configure_first_packet = ProtoField.uint32("vibrocast.configure.first_packet", "first_packet")
fields.configure_loops = ProtoField.uint16("vibrocast.configure.loops", "loops")
fields.configure_gain = ProtoField.float("vibrocast.configure.gain", "gain")
fields.configure_header = ProtoField.bytes("vibrocast.configure.header", "header")
fields.queue_stream = ProtoField.uint8("vibrocast.queue.stream", "stream")
fields.queue_compensation = ProtoField.uint8("vibrocast.queue.compensation", "compensation")
fields.queue_prebuffer_samples = ProtoField.uint32("vibrocast.queue.prebuffer_samples", "prebuffer_samples")
fields.queue_packets = ProtoField.uint32("vibrocast.queue.packets", "packets")
fields.queue_first_packet = ProtoField.uint32("vibrocast.queue.first_packet", "first_packet")
fields.queue_loops = ProtoField.uint16("vibrocast.queue.loops", "loops")
fields.queue_gain = ProtoField.float("vibrocast.queue.gain", "gain")
fields.queue_header = ProtoField.bytes("vibrocast.queue.header", "header")
fields.start_device_time_us = ProtoField.uint64("vibrocast.start.device_time_us", "device_time_us")
fields.loop_loops = ProtoField.uint16("vibrocast.loop.loops", "loops")
fields.gain_gain = ProtoField.float("vibrocast.gain.gain", "gain")
fields.end_stream_stream = ProtoField.uint8("vibrocast.end_stream.stream", "stream")
fields.end_stream_packets = ProtoField.uint32("vibrocast.end_stream.packets", "packets")
fields.capture_read_tap = ProtoField.uint8("vibrocast.capture_read.tap", "tap", base.DEC, {[0] = "DECODED", [1] = "DAC"})
fields.capture_read_offset = ProtoField.uint64("vibrocast.capture_read.offset", "offset")
fields.capture_read_count = ProtoField.uint16("vibrocast.capture_read.count", "count")
fields.flash_begin_slot = ProtoField.uint8("vibrocast.flash_begin.slot", "slot")
fields.flash_begin_size_bytes = ProtoField.uint32("vibrocast.flash_begin.size_bytes", "size_bytes")
fields.flash_begin_sha256 = ProtoField.bytes("vibrocast.flash_begin.sha256", "sha256")
fields.flash_begin_hardware = ProtoField.string("vibrocast.flash_begin.hardware", "hardware")
fields.flash_data_slot = ProtoField.uint8("vibrocast.flash_data.slot", "slot")
fields.flash_data_offset = ProtoField.uint32("vibrocast.flash_data.offset", "offset")
fields.flash_data_data = ProtoField.bytes("vibrocast.flash_data.data", "data")
fields.flash_verify_slot = ProtoField.uint8("vibrocast.flash_verify.slot", "slot")
fields.flash_activate_slot = ProtoField.uint8("vibrocast.flash_activate.slot", "slot")
fields.flash_confirm_slot = ProtoField.uint8("vibrocast.flash_confirm.slot", "slot")
fields.flash_erase_slot = ProtoField.uint8("vibrocast.flash_erase.slot", "slot")
fields.flash_read_slot = ProtoField.uint8("vibrocast.flash_read.slot", "slot")
fields.flash_read_offset = ProtoField.uint32("vibrocast.flash_read.offset", "offset")
fields.flash_read_count = ProtoField.uint16("vibrocast.flash_read.count", "count")
fields.stream_data_stream = ProtoField.uint8("vibrocast.stream_data.stream", "stream")
fields.stream_data_iteration = ProtoField.uint32("vibrocast.stream_data.iteration", "iteration")
fields.stream_data_packets = ProtoField.bytes("vibrocast.stream_data.packets", "packets")
fields.position_device_time_us = ProtoField.uint64("vibrocast.position.device_time_us", "device_time_us")
fields.position_position_nm = ProtoField.int64("vibrocast.position.position_nm", "position_nm")
fields.single_packet_stream = ProtoField.uint8("vibrocast.single_packet.stream", "stream")
fields.single_packet_packet = ProtoField.bytes("vibrocast.single_packet.packet", "packet")
fields.hello_response_major = ProtoField.uint8("vibrocast.hello_response.major", "major")
fields.hello_response_minor = ProtoField.uint8("vibrocast.hello_response.minor", "minor")
fields.hello_response_build = ProtoField.string("vibrocast.hello_response.build", "build")
fields.hello_response_hardware = ProtoField.string("vibrocast.hello_response.hardware", "hardware")
fields.hello_response_limits = ProtoField.bytes("vibrocast.hello_response.limits", "limits")
fields.hello_response_actuator = ProtoField.bytes("vibrocast.hello_response.actuator", "actuator")
fields.hello_response_codecs = ProtoField.bytes("vibrocast.hello_response.codecs", "codecs")
fields.hello_response_images = ProtoField.bytes("vibrocast.hello_response.images", "images")
fields.hello_response_public_key = ProtoField.bytes("vibrocast.hello_response.public_key", "public_key")
fields.hello_response_serial_number = ProtoField.string("vibrocast.hello_response.serial_number", "serial_number")
fields.status_state = ProtoField.uint8("vibrocast.status.state", "state", base.DEC, {[0] = "IDLE", [1] = "BUFFERING", [2] = "ARMED", [3] = "PLAYING", [4] = "PAUSED", [5] = "FINISHED", [6] = "STOPPED", [7] = "WATCHDOG", [8] = "FAULT"})
fields.status_stream = ProtoField.uint8("vibrocast.status.stream", "stream")
fields.status_device_time_us = ProtoField.uint64("vibrocast.status.device_time_us", "device_time_us")
fields.status_position = ProtoField.uint64("vibrocast.status.position", "position")
fields.status_credit_until = ProtoField.uint64("vibrocast.status.credit_until", "credit_until")
fields.status_buffered_samples = ProtoField.uint32("vibrocast.status.buffered_samples", "buffered_samples")
fields.status_bad_frames = ProtoField.uint32("vibrocast.status.bad_frames", "bad_frames")
fields.status_underruns = ProtoField.uint32("vibrocast.status.underruns", "underruns")
fields.status_lost_packets = ProtoField.uint32("vibrocast.status.lost_packets", "lost_packets")
fields.status_compensation_clipped = ProtoField.uint32("vibrocast.status.compensation_clipped", "compensation_clipped")
fields.status_voltage_limited = ProtoField.uint32("vibrocast.status.voltage_limited", "voltage_limited")
fields.status_slew_limited = ProtoField.uint32("vibrocast.status.slew_limited", "slew_limited")
fields.status_power_limited = ProtoField.uint32("vibrocast.status.power_limited", "power_limited")
fields.status_output_gaps = ProtoField.uint32("vibrocast.status.output_gaps", "output_gaps")
fields.status_late_samples = ProtoField.uint32("vibrocast.status.late_samples", "late_samples")
fields.status_signed_images = ProtoField.uint8("vibrocast.status.signed_images", "signed_images")
fields.status_coding = ProtoField.bytes("vibrocast.status.coding", "coding")
fields.status_queued = ProtoField.bytes("vibrocast.status.queued", "queued")
fields.status_output_faults = ProtoField.bytes("vibrocast.status.output_faults", "output_faults")
fields.status_frame_faults = ProtoField.bytes("vibrocast.status.frame_faults", "frame_faults")
fields.capture_data_tap = ProtoField.uint8("vibrocast.capture_data.tap", "tap", base.DEC, {[0] = "DECODED", [1] = "DAC"})
fields.capture_data_channels = ProtoField.uint8("vibrocast.capture_data.channels", "channels")
fields.capture_data_offset = ProtoField.uint64("vibrocast.capture_data.offset", "offset")
fields.capture_data_end = ProtoField.uint64("vibrocast.capture_data.end", "end")
fields.capture_data_data = ProtoField.bytes("vibrocast.capture_data.data", "data")
fields.flash_status_slot = ProtoField.uint8("vibrocast.flash_status.slot", "slot")
fields.flash_status_state = ProtoField.uint8("vibrocast.flash_status.state", "state", base.DEC, {[0] = "EMPTY", [1] = "WRITING", [2] = "VERIFIED", [3] = "TESTING", [4] = "CONFIRMED"})
fields.flash_status_next_offset = ProtoField.uint32("vibrocast.flash_status.next_offset", "next_offset")
fields.flash_status_sha256 = ProtoField.bytes("vibrocast.flash_status.sha256", "sha256")
fields.flash_contents_slot = ProtoField.uint8("vibrocast.flash_contents.slot", "slot")
fields.flash_contents_size_bytes = ProtoField.uint32("vibrocast.flash_contents.size_bytes", "size_bytes")
fields.flash_contents_offset = ProtoField.uint32("vibrocast.flash_contents.offset", "offset")
fields.flash_contents_data = ProtoField.bytes("vibrocast.flash_contents.data", "data")
fields.error_code = ProtoField.uint16("vibrocast.error.code", "code")
fields.error_text = ProtoField.string("vibrocast.error.text", "text")
fields.limits_max_payload_bytes = ProtoField.uint16("vibrocast.limits.max_payload_bytes", "max_payload_bytes")
fields.limits_max_packet_bytes = ProtoField.uint16("vibrocast.limits.max_packet_bytes", "max_packet_bytes")
fields.limits_buffer_samples = ProtoField.uint32("vibrocast.limits.buffer_samples", "buffer_samples")
fields.limits_capture_samples = ProtoField.uint32("vibrocast.limits.capture_samples", "capture_samples")
fields.limits_channels = ProtoField.uint8("vibrocast.limits.channels", "channels")
fields.limits_min_rate_hz = ProtoField.uint32("vibrocast.limits.min_rate_hz", "min_rate_hz")
fields.limits_max_rate_hz = ProtoField.uint32("vibrocast.limits.max_rate_hz", "max_rate_hz")
fields.limits_watchdog_ms = ProtoField.uint16("vibrocast.limits.watchdog_ms", "watchdog_ms")
fields.limits_profile_samples = ProtoField.uint32("vibrocast.limits.profile_samples", "profile_samples")
fields.limits_packet_samples = ProtoField.uint32("vibrocast.limits.packet_samples", "packet_samples")
fields.limits_decoding_kilocycles_per_s = ProtoField.uint32("vibrocast.limits.decoding_kilocycles_per_s", "decoding_kilocycles_per_s")
fields.actuator_description_stroke_um = ProtoField.float("vibrocast.actuator_description.stroke_um", "stroke_um")
fields.actuator_description_volts = ProtoField.float("vibrocast.actuator_description.volts", "volts")
fields.actuator_description_lower_hz = ProtoField.float("vibrocast.actuator_description.lower_hz", "lower_hz")
fields.actuator_description_upper_hz = ProtoField.float("vibrocast.actuator_description.upper_hz", "upper_hz")
fields.actuator_description_slew_volts_per_second = ProtoField.float("vibrocast.actuator_description.slew_volts_per_second", "slew_volts_per_second")
fields.actuator_description_dac_bits = ProtoField.uint8("vibrocast.actuator_description.dac_bits", "dac_bits")
fields.actuator_description_dac_rate_hz = ProtoField.uint32("vibrocast.actuator_description.dac_rate_hz", "dac_rate_hz")
fields.actuator_description_name = ProtoField.string("vibrocast.actuator_description.name", "name")
fields.codec_description_identifier = ProtoField.uint8("vibrocast.codec_description.identifier", "identifier")
fields.codec_description_name = ProtoField.string("vibrocast.codec_description.name", "name")
fields.image_description_slot = ProtoField.uint8("vibrocast.image_description.slot", "slot")
fields.image_description_state = ProtoField.uint8("vibrocast.image_description.state", "state", base.DEC, {[0] = "EMPTY", [1] = "WRITING", [2] = "VERIFIED", [3] = "TESTING", [4] = "CONFIRMED"})
fields.image_description_sha256 = ProtoField.bytes("vibrocast.image_description.sha256", "sha256")
fields.image_description_number = ProtoField.uint32("vibrocast.image_description.number", "number")
fields.image_description_name = ProtoField.string("vibrocast.image_description.name", "name")
fields.image_description_version = ProtoField.string("vibrocast.image_description.version", "version")
fields.coding_description_packet_samples = ProtoField.uint32("vibrocast.coding_description.packet_samples", "packet_samples")
fields.coding_description_delay_samples = ProtoField.uint32("vibrocast.coding_description.delay_samples", "delay_samples")
fields.queued_stream_stream = ProtoField.uint8("vibrocast.queued_stream.stream", "stream")
fields.queued_stream_credit_until = ProtoField.uint64("vibrocast.queued_stream.credit_until", "credit_until")
fields.output_faults_refused = ProtoField.uint32("vibrocast.output_faults.refused", "refused")
fields.output_faults_restarts = ProtoField.uint32("vibrocast.output_faults.restarts", "restarts")
fields.frame_faults_repeated = ProtoField.uint32("vibrocast.frame_faults.repeated", "repeated")
fields.frame_faults_reordered = ProtoField.uint32("vibrocast.frame_faults.reordered", "reordered")

-- Of each struct: name and kind of its fields, in their order; by tag, the struct or the name of a plain value.
local structs = {
    hello = {
        fields = { { "major", "u8" }, { "minor", "u8" },  },
        tags = {  },
    },
    status_request = {
        fields = {  },
        tags = {  },
    },
    configure = {
        fields = { { "stream", "u8" }, { "compensation", "u8" }, { "prebuffer_samples", "u32" }, { "packets", "u32" }, { "first_packet", "u32" }, { "loops", "u16" }, { "gain", "f32" },  },
        tags = { [1] = { "header" },  },
    },
    queue = {
        fields = { { "stream", "u8" }, { "compensation", "u8" }, { "prebuffer_samples", "u32" }, { "packets", "u32" }, { "first_packet", "u32" }, { "loops", "u16" }, { "gain", "f32" },  },
        tags = { [1] = { "header" },  },
    },
    start = {
        fields = { { "device_time_us", "u64" },  },
        tags = {  },
    },
    pause = {
        fields = {  },
        tags = {  },
    },
    resume = {
        fields = {  },
        tags = {  },
    },
    stop = {
        fields = {  },
        tags = {  },
    },
    loop = {
        fields = { { "loops", "u16" },  },
        tags = {  },
    },
    gain = {
        fields = { { "gain", "f32" },  },
        tags = {  },
    },
    end_stream = {
        fields = { { "stream", "u8" }, { "packets", "u32" },  },
        tags = {  },
    },
    capture_read = {
        fields = { { "tap", "u8" }, { "offset", "u64" }, { "count", "u16" },  },
        tags = {  },
    },
    flash_begin = {
        fields = { { "slot", "u8" }, { "size_bytes", "u32" }, { "sha256", "32" },  },
        tags = { [1] = { "hardware" },  },
    },
    flash_data = {
        fields = { { "slot", "u8" }, { "offset", "u32" }, { "data", "bytes" },  },
        tags = {  },
    },
    flash_verify = {
        fields = { { "slot", "u8" },  },
        tags = {  },
    },
    flash_activate = {
        fields = { { "slot", "u8" },  },
        tags = {  },
    },
    flash_confirm = {
        fields = { { "slot", "u8" },  },
        tags = {  },
    },
    flash_erase = {
        fields = { { "slot", "u8" },  },
        tags = {  },
    },
    flash_read = {
        fields = { { "slot", "u8" }, { "offset", "u32" }, { "count", "u16" },  },
        tags = {  },
    },
    stream_data = {
        fields = { { "stream", "u8" }, { "iteration", "varint" }, { "packets", "items" },  },
        tags = {  },
    },
    position = {
        fields = { { "device_time_us", "u64" }, { "position_nm", "i64" },  },
        tags = {  },
    },
    single_packet = {
        fields = { { "stream", "u8" }, { "packet", "bytes" },  },
        tags = {  },
    },
    hello_response = {
        fields = { { "major", "u8" }, { "minor", "u8" },  },
        tags = { [1] = { "build" }, [2] = { "hardware" }, [3] = { "limits", "limits" }, [4] = { "actuator", "actuator_description" }, [5] = { "codecs", "codec_description" }, [6] = { "images", "image_description" }, [7] = { "public_key" }, [8] = { "serial_number" },  },
    },
    status = {
        fields = { { "state", "u8" }, { "stream", "u8" }, { "device_time_us", "u64" }, { "position", "u64" }, { "credit_until", "u64" }, { "buffered_samples", "u32" }, { "bad_frames", "u32" }, { "underruns", "u32" }, { "lost_packets", "u32" }, { "compensation_clipped", "u32" }, { "voltage_limited", "u32" }, { "slew_limited", "u32" }, { "power_limited", "u32" }, { "output_gaps", "u32" }, { "late_samples", "u32" }, { "signed_images", "u8" },  },
        tags = { [1] = { "coding", "coding_description" }, [2] = { "queued", "queued_stream" }, [3] = { "output_faults", "output_faults" }, [4] = { "frame_faults", "frame_faults" },  },
    },
    capture_data = {
        fields = { { "tap", "u8" }, { "channels", "u8" }, { "offset", "u64" }, { "end", "u64" }, { "data", "bytes" },  },
        tags = {  },
    },
    flash_status = {
        fields = { { "slot", "u8" }, { "state", "u8" }, { "next_offset", "u32" }, { "sha256", "32" },  },
        tags = {  },
    },
    flash_contents = {
        fields = { { "slot", "u8" }, { "size_bytes", "u32" }, { "offset", "u32" }, { "data", "bytes" },  },
        tags = {  },
    },
    error = {
        fields = { { "code", "u16" },  },
        tags = { [1] = { "text" },  },
    },
    limits = {
        fields = { { "max_payload_bytes", "u16" }, { "max_packet_bytes", "u16" }, { "buffer_samples", "u32" }, { "capture_samples", "u32" }, { "channels", "u8" }, { "min_rate_hz", "u32" }, { "max_rate_hz", "u32" }, { "watchdog_ms", "u16" }, { "profile_samples", "u32" }, { "packet_samples", "u32" }, { "decoding_kilocycles_per_s", "u32" },  },
        tags = {  },
    },
    actuator_description = {
        fields = { { "stroke_um", "f32" }, { "volts", "f32" }, { "lower_hz", "f32" }, { "upper_hz", "f32" }, { "slew_volts_per_second", "f32" }, { "dac_bits", "u8" }, { "dac_rate_hz", "u32" }, { "name", "text" },  },
        tags = {  },
    },
    codec_description = {
        fields = { { "identifier", "u8" }, { "name", "text" },  },
        tags = {  },
    },
    image_description = {
        fields = { { "slot", "u8" }, { "state", "u8" }, { "sha256", "32" }, { "number", "u32" }, { "name", "counted" }, { "version", "text" },  },
        tags = {  },
    },
    coding_description = {
        fields = { { "packet_samples", "u32" }, { "delay_samples", "u32" },  },
        tags = {  },
    },
    queued_stream = {
        fields = { { "stream", "u8" }, { "credit_until", "u64" },  },
        tags = {  },
    },
    output_faults = {
        fields = { { "refused", "u32" }, { "restarts", "u32" },  },
        tags = {  },
    },
    frame_faults = {
        fields = { { "repeated", "u32" }, { "reordered", "u32" },  },
        tags = {  },
    },
}

local names = {
    [1] = { "Hello", "hello" },
    [2] = { "StatusRequest", "status_request" },
    [3] = { "Configure", "configure" },
    [12] = { "Queue", "queue" },
    [4] = { "Start", "start" },
    [5] = { "Pause", "pause" },
    [6] = { "Resume", "resume" },
    [7] = { "Stop", "stop" },
    [8] = { "Loop", "loop" },
    [9] = { "Gain", "gain" },
    [10] = { "EndStream", "end_stream" },
    [11] = { "CaptureRead", "capture_read" },
    [16] = { "FlashBegin", "flash_begin" },
    [17] = { "FlashData", "flash_data" },
    [18] = { "FlashVerify", "flash_verify" },
    [19] = { "FlashActivate", "flash_activate" },
    [20] = { "FlashConfirm", "flash_confirm" },
    [21] = { "FlashErase", "flash_erase" },
    [22] = { "FlashRead", "flash_read" },
    [64] = { "StreamData", "stream_data" },
    [65] = { "Position", "position" },
    [66] = { "SinglePacket", "single_packet" },
    [128] = { "HelloResponse", "hello_response" },
    [129] = { "Status", "status" },
    [130] = { "CaptureData", "capture_data" },
    [131] = { "FlashStatus", "flash_status" },
    [132] = { "FlashContents", "flash_contents" },
    [255] = { "Error", "error" },
}

local sizes = { u8 = 1, u16 = 2, u32 = 4, u64 = 8, i64 = 8, f32 = 4 }

-- Returns a ByteArray, or nil for bytes that are no COBS.
local function cobs_decode(tvb)
    local decoded, position, length = ByteArray.new(), 0, tvb:len()
    while position < length do
        local code = tvb(position, 1):uint()
        if code == 0 or position + code > length then return nil end
        if code > 1 then decoded = decoded .. tvb(position + 1, code - 1):bytes() end
        position = position + code
        if code < 255 and position < length then decoded = decoded .. ByteArray.new("00") end
    end
    return decoded
end

-- CRC-16/IBM-3740
local function crc16(bytes, length)
    local crc = 0xFFFF
    for index = 0, length - 1 do
        crc = bit.bxor(crc, bit.lshift(bytes:get_index(index), 8))
        for _ = 1, 8 do
            local carry = bit.band(crc, 0x8000) ~= 0
            crc = bit.band(bit.lshift(crc, 1), 0xFFFF)
            if carry then crc = bit.bxor(crc, 0x1021) end
        end
    end
    return crc
end

-- Adds one field to the tree; returns the position after it, or nil where the message is cut.
local function read(tvb, tree, struct, name, kind, position)
    local field, left = fields[struct .. "_" .. name], tvb:len() - position
    local size = sizes[kind] or tonumber(kind)
    if kind == "text" or kind == "bytes" or kind == "items" then
        if left > 0 then tree:add(field, tvb(position, left)) end
        return tvb:len()
    elseif kind == "counted" then
        if left < 1 then return nil end
        local length = tvb(position, 1):uint()
        if left < 1 + length then return nil end
        if length > 0 then tree:add(field, tvb(position + 1, length)) end
        return position + 1 + length
    elseif kind == "varint" then
        local value, shift, used = 0, 1, 0
        repeat
            if used >= left or used == 5 then return nil end
            local byte = tvb(position + used, 1):uint()
            value, shift, used = value + bit.band(byte, 0x7F) * shift, shift * 128, used + 1
        until byte < 128
        tree:add(field, tvb(position, used), value)
        return position + used
    end
    if left < size then return nil end
    if tonumber(kind) then tree:add(field, tvb(position, size)) else tree:add_le(field, tvb(position, size)) end
    return position + size
end

-- Adds the fields of a struct, and behind them its tags.
local function read_struct(tvb, tree, struct, position)
    for _, field in ipairs(structs[struct].fields) do
        position = read(tvb, tree, struct, field[1], field[2], position)
        if position == nil then
            tree:add_proto_expert_info(cut_message)
            return
        end
    end
    while position + 3 <= tvb:len() do
        local tag, length = tvb(position, 1):uint(), tvb(position + 1, 2):le_uint()
        local known = structs[struct].tags[tag]
        if position + 3 + length > tvb:len() then
            tree:add_proto_expert_info(cut_message)
            return
        end
        local whole = tvb(position, 3 + length)
        if length == 0 then
            tree:add(fields.tag, tvb(position, 1))
        elseif known == nil then
            tree:add(fields.tag, tvb(position, 1)):append_text(" (unknown)")
        elseif known[2] then
            read_struct(tvb(position + 3, length):tvb(), tree:add(vibrocast, whole, known[1]), known[2], 0)
        else
            tree:add(fields[struct .. "_" .. known[1]], tvb(position + 3, length))
        end
        position = position + 3 + length
    end
end

function vibrocast.dissector(tvb, pinfo, root)
    pinfo.cols.protocol = "vibrocast"
    pinfo.cols.src = pinfo.p2p_dir == 0 and "host" or "controller"
    pinfo.cols.dst = pinfo.p2p_dir == 0 and "controller" or "host"
    local decoded = cobs_decode(tvb)
    local size = decoded and decoded:len() - 2 or 0
    local tree = root:add(vibrocast, tvb())
    if size < 1 or crc16(decoded, size) ~= decoded:get_index(size) + 256 * decoded:get_index(size + 1) then
        pinfo.cols.info = "damaged frame"
        tree:add_proto_expert_info(bad_frame)
        return
    end
    local message = decoded:subset(0, size):tvb("message")
    local type = message(0, 1):uint()
    local name, position = names[type], 1
    tree:add(fields.type, message(0, 1)):append_text(name and " (" .. name[1] .. ")" or " (unknown)")
    pinfo.cols.info = name and name[1] or string.format("message 0x%02x", type)
    if type < 64 or type >= 128 then
        if size < 3 then
            tree:add_proto_expert_info(cut_message)
            return
        end
        tree:add_le(fields.sequence, message(1, 2))
        pinfo.cols.info:append(" " .. message(1, 2):le_uint())
        position = 3
    end
    if name then read_struct(message, tree, name[2], position) end
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, vibrocast)
