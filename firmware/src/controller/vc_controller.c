/* The controller: sessions, requests and their answers, the watchdog, notifications; see controller.h. */
#include "vibrocast/controller.h"

#include "vc_controller_memory.h"

#define STATUS_INTERVAL_US 100000u
#define US_PER_MS 1000u
#define TEXT_OF(number) #number
#define VERSION_OF(major, minor) TEXT_OF(major) "." TEXT_OF(minor)
#define VERSION_TEXT VERSION_OF(VC_PROTOCOL_MAJOR, VC_PROTOCOL_MINOR)
/* Bytes of notifications that a host may leave unread; answers have the rest. */
#define UNREAD_NOTIFICATIONS_BYTES (VC_OUTGOING_BYTES / 2)

size_t vc_controller_size(void)
{
    return sizeof(vc_controller);
}

size_t vc_controller_profile_size(void)
{
    return VC_PROFILE_WORDS * sizeof(int64_t);
}

/* ---- output to the host ---- */

static uint32_t outgoing_bytes(const vc_controller *controller)
{
    return controller->outgoing_end - controller->outgoing_at;
}

static void send(vc_controller *controller, const uint8_t *frame, uint32_t length)
{
    const uint32_t unread = outgoing_bytes(controller);
    uint32_t i;
    if (length > VC_OUTGOING_BYTES - unread)
        return; /* the host repeats its request */
    if (length > VC_OUTGOING_BYTES - controller->outgoing_end) {
        for (i = 0; i < unread; i++)
            controller->outgoing[i] = controller->outgoing[controller->outgoing_at + i];
        controller->outgoing_at = 0;
        controller->outgoing_end = unread;
    }
    memcpy(controller->outgoing + controller->outgoing_end, frame, length);
    controller->outgoing_end += length;
}

size_t vc_controller_transmit(vc_controller *controller, uint8_t *data, size_t capacity)
{
    const uint32_t unread = outgoing_bytes(controller);
    const uint32_t moved = capacity < unread ? (uint32_t)capacity : unread;
    memcpy(data, controller->outgoing + controller->outgoing_at, moved);
    controller->outgoing_at += moved;
    return moved;
}

static enum vc_state state_of(const vc_controller *controller)
{
    return controller->configured ? controller->playback.state : controller->state_without_stream;
}

static int is_active(enum vc_state state)
{
    return state == VC_STATE_ARMED || state == VC_STATE_PLAYING || state == VC_STATE_PAUSED;
}

static vc_status_report status_of(vc_controller *controller)
{
    vc_status_report status;
    memset(&status, 0, sizeof status);
    status.state = (uint8_t)state_of(controller);
    if (controller->configured)
        vc_playback_report(&controller->playback, &status);
    status.device_time_us = controller->time_us;
    status.bad_frames = vc_frame_reader_bad_frames(&controller->reader);
    if (controller->frame_faults.repeated || controller->frame_faults.reordered)
        status.frame_faults = &controller->frame_faults;
    status.signed_images = controller->settings->public_key != NULL;
    return status;
}

/* `coding`: how the stream is coded, in the answer to Configure or Queue; NULL in any other Status. */
static void write_status(vc_controller *controller, vc_frame_writer *writer, uint16_t sequence,
                         const vc_coding_description *coding)
{
    vc_status_report status = status_of(controller);
    controller->reported = 1;
    controller->last_state = status.state;
    controller->last_stream = status.stream;
    controller->last_underruns = status.underruns;
    controller->last_credit_until = status.credit_until;
    controller->last_time_us = status.device_time_us;
    status.coding = coding;
    vc_write_status(writer, sequence, &status);
}

/* Frames that are not kept for a repeated request: errors and notifications. */
#define SMALL_FRAME_BYTES 256

static void send_error(vc_controller *controller, uint16_t sequence, const vc_rejection *rejection)
{
    uint8_t frame[SMALL_FRAME_BYTES];
    vc_frame_writer writer;
    vc_frame_begin(&writer, frame, sizeof frame);
    vc_write_rejection(&writer, sequence, rejection);
    send(controller, frame, (uint32_t)vc_frame_end(&writer));
}

/* Sends a Status after an event that the host must know, and after some time without one. */
static void notify(vc_controller *controller)
{
    uint8_t frame[SMALL_FRAME_BYTES];
    vc_frame_writer writer;
    vc_status_report status;
    if (!controller->in_session || !controller->configured)
        return;
    status = status_of(controller);
    if (controller->reported && status.state == controller->last_state && status.stream == controller->last_stream &&
        status.underruns <= controller->last_underruns &&
        status.credit_until < controller->last_credit_until + vc_playback_capacity_samples(&controller->playback) / 4 &&
        !((status.state == VC_STATE_ARMED || status.state == VC_STATE_PLAYING) &&
          status.device_time_us - controller->last_time_us >= STATUS_INTERVAL_US))
        return;
    if (outgoing_bytes(controller) >= UNREAD_NOTIFICATIONS_BYTES)
        return;
    vc_frame_begin(&writer, frame, sizeof frame);
    write_status(controller, &writer, VC_NOTIFICATION, NULL);
    send(controller, frame, (uint32_t)vc_frame_end(&writer));
}

/* ---- requests: each puts its answer and returns 0, or returns the rejection's code ---- */

/* Ramps down at once: the DAC takes the whole ramp. After it, another stream may use the DAC. */
static void stop(vc_controller *controller)
{
    vc_playback *playback = &controller->playback;
    uint64_t free_us;
    controller->state_without_stream = VC_STATE_STOPPED;
    if (!controller->configured)
        return;
    vc_playback_stop(playback, VC_STATE_STOPPED);
    vc_playback_flush(playback, controller->time_us);
    free_us = vc_playback_free_us(playback);
    if (free_us > controller->dac_free_us)
        controller->dac_free_us = free_us;
}

/* Rejects a request in other states than these; `states`: a bit for each allowed state. */
static int reject_outside(const vc_controller *controller, unsigned states, vc_rejection *rejection)
{
    static const char *const names[] = {"idle",     "buffering", "armed",    "playing", "paused",
                                        "finished", "stopped",   "watchdog", "fault"};
    const char *before = "; this needs it ";
    unsigned state;
    if (controller->configured && (states >> state_of(controller) & 1u))
        return 0;
    vc_reject(rejection, VC_WRONG_STATE, "the controller is ");
    vc_rejection_add(rejection, names[state_of(controller)]);
    for (state = 0; state < sizeof names / sizeof names[0]; state++)
        if (states >> state & 1u) {
            vc_rejection_add(rejection, before);
            vc_rejection_add(rejection, names[state]);
            before = " or ";
        }
    return rejection->code;
}

static int reject_while_active(const vc_controller *controller, vc_rejection *rejection)
{
    return is_active(state_of(controller))
               ? vc_reject(rejection, VC_WRONG_STATE, "a stream is being played: stop it first")
               : 0;
}

/* Finds the coding of a stream: a model image provides its tables. */
static int find_coding(const vc_controller *controller, const vc_stream_header *header, vc_coding *coding,
                       vc_rejection *rejection)
{
    const vc_model_image *image = vc_image_store_running(&controller->images);
    memset(coding, 0, sizeof *coding);
    coding->codec = header->codec;
    coding->channels = header->output.channels;
    coding->configuration = header->configuration;
    coding->configuration_length = header->configuration_length;
    if (!header->needs_image)
        return 0;
    if (image == NULL ||
        !vc_same_bytes(vc_image_store_running_sha256(&controller->images), header->image_hash, VC_IMAGE_HASH_BYTES)) {
        vc_reject(rejection, VC_UNKNOWN_IMAGE, "the stream needs model image ");
        vc_rejection_add_hex(rejection, header->image_hash, VC_IMAGE_HASH_BYTES);
        return vc_rejection_add(rejection, ", which does not run here: upload it first");
    }
    if (image->codec != header->codec)
        return vc_reject_numbers(rejection, VC_UNKNOWN_IMAGE,
                                 "the model image is for codec #, the stream is of codec #", image->codec,
                                 header->codec);
    coding->tables = image->payload.bytes;
    coding->tables_length = image->payload.length;
    return 0;
}

/* Sets a stream up in place of the one under way, or behind it. */
static int configure(vc_controller *controller, const vc_configure *configure, int behind, vc_rejection *rejection)
{
    vc_stream_header header;
    vc_coding coding;
    int rejected = vc_stream_header_read(&header, configure->header.bytes, configure->header.length, rejection);
    if (!rejected)
        rejected = find_coding(controller, &header, &coding, rejection);
    if (!rejected)
        rejected = vc_playback_check(configure, &header, &coding, controller->settings, controller->playback.actuator,
                                     rejection);
    if (rejected)
        return rejected;
    if (behind)
        return vc_playback_queue(&controller->playback, configure, &header, &coding, rejection);
    stop(controller);
    vc_playback_init(&controller->playback, configure, &header, &coding);
    controller->configured = 1;
    return 0;
}

static int end_stream(vc_controller *controller, const vc_end_stream *end, vc_rejection *rejection)
{
    vc_playback *playback = &controller->playback;
    if (!playback->live || end->stream != playback->stream)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "stream # is not a live stream that plays here", end->stream,
                                 0);
    vc_playback_end_live(playback, end->packets);
    return 0;
}

static int write_capture(vc_controller *controller, const vc_capture_read *read, uint16_t sequence,
                         vc_frame_writer *writer, vc_rejection *rejection)
{
    const vc_playback *playback = &controller->playback;
    uint64_t offset = read->offset;
    vc_capture_data capture;
    vc_run runs[2];
    unsigned channels, room, run;
    if (!controller->configured)
        return vc_reject(rejection, VC_WRONG_STATE, "nothing has been captured yet: configure a stream first");
    channels = playback->header.output.channels;
    room = (VC_MAX_PAYLOAD_BYTES - VC_CAPTURE_DATA_HEAD_BYTES) / (2u * channels);
    vc_playback_captured(playback, read->tap, &offset, read->count < room ? read->count : room, runs);
    capture.tap = read->tap;
    capture.channels = (uint8_t)channels;
    capture.offset = offset;
    capture.end = playback->captures[read->tap].end;
    vc_write_capture_data(writer, sequence, &capture);
    for (run = 0; run < 2; run++)
        vc_frame_write_samples(writer, runs[run].samples, (size_t)runs[run].count * channels);
    return 0;
}

static int write_contents(vc_controller *controller, vc_flash_read read, uint16_t sequence, vc_frame_writer *writer,
                          vc_rejection *rejection)
{
    vc_flash_contents contents;
    int rejected;
    if (read.count > VC_MAX_PAYLOAD_BYTES - VC_FLASH_CONTENTS_HEAD_BYTES)
        read.count = VC_MAX_PAYLOAD_BYTES - VC_FLASH_CONTENTS_HEAD_BYTES;
    rejected = vc_image_store_read(&controller->images, &read, &contents, rejection);
    if (!rejected)
        vc_write_flash_contents(writer, sequence, &contents);
    return rejected;
}

static int write_flash(vc_controller *controller, const vc_message *message, vc_frame_writer *writer,
                       vc_rejection *rejection)
{
    vc_image_store *images = &controller->images;
    vc_flash_status report;
    int rejected = reject_while_active(controller, rejection); /* they may take longer than a block */
    if (rejected)
        return rejected;
    switch (message->type) {
    case VC_FLASH_BEGIN:
        rejected = vc_image_store_begin(images, &message->body.flash_begin, &report, rejection);
        break;
    case VC_FLASH_DATA:
        rejected = vc_image_store_write(images, &message->body.flash_data, &report, rejection);
        break;
    case VC_FLASH_VERIFY:
        rejected = vc_image_store_verify(images, message->body.flash_verify.slot, &report, rejection);
        break;
    case VC_FLASH_ACTIVATE:
        rejected = vc_image_store_activate(images, message->body.flash_activate.slot, &report, rejection);
        break;
    case VC_FLASH_ERASE:
        rejected = vc_image_store_erase(images, message->body.flash_erase.slot, &report, rejection);
        break;
    case VC_FLASH_READ:
        return write_contents(controller, message->body.flash_read, message->sequence, writer, rejection);
    default:
        rejected = vc_image_store_confirm(images, message->body.flash_confirm.slot, &report, rejection);
        break;
    }
    if (!rejected)
        vc_write_flash_status(writer, message->sequence, &report);
    return rejected;
}

#define IN(state) (1u << (state))
#define IN_STREAM (IN(VC_STATE_BUFFERING) | IN(VC_STATE_ARMED) | IN(VC_STATE_PLAYING) | IN(VC_STATE_PAUSED))

/* Carries out a request other than Hello and puts its answer. */
static int dispatch(vc_controller *controller, const vc_message *message, vc_frame_writer *writer,
                    vc_rejection *rejection)
{
    vc_playback *playback = &controller->playback;
    uint64_t start_us;
    int rejected = 0;
    switch (message->type) {
    case VC_STATUS_REQUEST:
        break;
    case VC_CONFIGURE:
        rejected = configure(controller, &message->body.configure, 0, rejection);
        break;
    case VC_QUEUE:
        rejected = reject_outside(controller, IN_STREAM, rejection);
        if (!rejected)
            rejected = configure(controller, &message->body.queue, 1, rejection);
        break;
    case VC_START:
        rejected = reject_outside(controller, IN(VC_STATE_BUFFERING), rejection);
        start_us = message->body.start.device_time_us;
        if (!rejected)
            vc_playback_start(playback, start_us > controller->dac_free_us ? start_us : controller->dac_free_us,
                              controller->time_us);
        break;
    case VC_PAUSE:
        rejected = reject_outside(controller, IN(VC_STATE_PLAYING), rejection);
        if (!rejected)
            vc_playback_pause(playback);
        break;
    case VC_RESUME:
        rejected = reject_outside(controller, IN(VC_STATE_PAUSED), rejection);
        if (!rejected)
            vc_playback_resume(playback);
        break;
    case VC_STOP:
        stop(controller);
        break;
    case VC_LOOP:
        rejected = reject_outside(controller, IN_STREAM, rejection);
        if (!rejected)
            rejected = vc_playback_set_loops(playback, message->body.loop.loops, rejection);
        break;
    case VC_GAIN:
        rejected = reject_outside(controller, IN_STREAM, rejection);
        if (!rejected)
            vc_playback_set_gain(playback, message->body.gain.gain_float_bits);
        break;
    case VC_END_STREAM:
        rejected = reject_outside(controller, IN_STREAM, rejection);
        if (!rejected)
            rejected = end_stream(controller, &message->body.end_stream, rejection);
        break;
    case VC_CAPTURE_READ:
        return write_capture(controller, &message->body.capture_read, message->sequence, writer, rejection);
    default:
        return write_flash(controller, message, writer, rejection);
    }
    if (!rejected && (message->type == VC_QUEUE || message->type == VC_CONFIGURE)) {
        const vc_coding *set_up = message->type == VC_QUEUE ? &playback->next_coding : &playback->coding;
        const vc_coding_description coding = {set_up->packet_samples, set_up->delay_samples};
        write_status(controller, writer, message->sequence, &coding);
    } else if (!rejected) {
        write_status(controller, writer, message->sequence, NULL);
    }
    return rejected;
}

static void write_description(vc_controller *controller, vc_frame_writer *writer, uint16_t sequence)
{
    const vc_actuator *actuator = controller->playback.actuator;
    const vc_decoder_callbacks *callbacks = controller->settings->callbacks;
    const vc_sizes sizes = vc_playback_sizes(controller->settings);
    vc_codec_description codecs[VC_CODEC_COUNT];
    vc_image_description images[VC_SLOTS];
    vc_hello_response hello;
    unsigned slot;
    memset(&hello, 0, sizeof hello);
    hello.major = VC_PROTOCOL_MAJOR;
    hello.minor = VC_PROTOCOL_MINOR;
    hello.build = vc_text_piece(controller->settings->build);
    hello.hardware = vc_text_piece(controller->settings->hardware);
    hello.limits.max_payload_bytes = VC_MAX_PAYLOAD_BYTES;
    hello.limits.max_packet_bytes = VC_MAX_PACKET_BYTES;
    hello.limits.buffer_samples = sizes.buffer_samples;
    hello.limits.capture_samples = sizes.capture_samples;
    hello.limits.channels = sizes.channels;
    hello.limits.min_rate_hz = VC_MIN_RATE_HZ;
    hello.limits.max_rate_hz = vc_playback_max_rate_hz(actuator);
    hello.limits.watchdog_ms = controller->settings->watchdog_ms;
    hello.limits.profile_samples = sizes.profile_samples;
    hello.limits.packet_samples = VC_PACKET_SAMPLES;
    hello.limits.decoding_kilocycles_per_s = controller->settings->decoding_kilocycles_per_s;
    hello.actuator.name = vc_text_piece(actuator->name);
    hello.actuator.stroke_um_float_bits = actuator->stroke_um;
    hello.actuator.volts_float_bits = actuator->volts;
    hello.actuator.lower_hz_float_bits = actuator->lower_hz;
    hello.actuator.upper_hz_float_bits = actuator->upper_hz;
    hello.actuator.slew_volts_per_second_float_bits = actuator->slew_volts_per_second;
    hello.actuator.dac_bits = actuator->dac_bits;
    hello.actuator.dac_rate_hz = actuator->dac_rate_hz;
    vc_codecs_describe(codecs);
    hello.codecs = callbacks != NULL ? callbacks->codecs : codecs;
    hello.codec_count = callbacks != NULL ? callbacks->codec_count : VC_CODEC_COUNT;
    hello.image_count = vc_image_store_slots(&controller->images);
    for (slot = 0; slot < hello.image_count; slot++) {
        vc_image_store_describe(&controller->images, slot, &images[slot]);
        images[slot].name.length = vc_text_cut(images[slot].name, VC_IMAGE_TEXT_BYTES);
        images[slot].version.length = vc_text_cut(images[slot].version, VC_IMAGE_TEXT_BYTES);
    }
    hello.images = images;
    if (controller->settings->public_key != NULL) {
        hello.public_key.bytes = controller->settings->public_key;
        hello.public_key.length = VC_KEY_BYTES;
    }
    if (controller->settings->serial_number != NULL)
        hello.serial_number = vc_text_piece(controller->settings->serial_number);
    vc_write_hello_response(writer, sequence, &hello);
}

/* ---- sessions ---- */

/* After a boot of the image store. */
static void start_idle(vc_controller *controller)
{
    controller->playback.actuator = vc_image_store_actuator(&controller->images);
    controller->configured = 0;
    controller->state_without_stream = VC_STATE_IDLE;
    controller->in_session = 0;
    controller->heard_us = controller->time_us;
    controller->reported = 0;
}

static void send_again(vc_controller *controller)
{
    send(controller, controller->answer, controller->answer_bytes);
}

/* Returns whether to carry out a request; for a copy of the last one, sends the kept answer again. */
static int is_new(vc_controller *controller, uint16_t sequence)
{
    const uint16_t ahead = (uint16_t)(sequence - controller->last_sequence);
    if (controller->in_session && ahead == 0)
        send_again(controller);
    return !controller->in_session || (ahead > 0 && ahead < 0x8000u);
}

/* Sends the answer in the finished frame, and keeps it. */
static void answer(vc_controller *controller, uint16_t sequence, vc_frame_writer *writer)
{
    controller->answer_bytes = (uint32_t)vc_frame_end(writer);
    controller->last_sequence = sequence;
    send_again(controller);
}

static void begin_answer(vc_controller *controller, vc_frame_writer *writer)
{
    vc_frame_begin(writer, controller->answer, sizeof controller->answer);
}

static void answer_error(vc_controller *controller, uint16_t sequence, const vc_rejection *rejection)
{
    vc_frame_writer writer;
    begin_answer(controller, &writer);
    vc_write_rejection(&writer, sequence, rejection);
    answer(controller, sequence, &writer);
}

/* Opens a session. Answers copies of the Hello that opened it again, until another request comes. */
static void greet(vc_controller *controller, uint16_t sequence, const vc_hello *hello)
{
    vc_frame_writer writer;
    vc_rejection rejection;
    if (controller->in_session && sequence == controller->opened_by) {
        if (sequence == controller->last_sequence)
            send_again(controller);
    } else if (hello->major != VC_PROTOCOL_MAJOR) {
        vc_reject_numbers(&rejection, VC_UNSUPPORTED_VERSION,
                          "this controller speaks protocol " VERSION_TEXT ", the host #.#: update the older one",
                          hello->major, hello->minor);
        send_error(controller, sequence, &rejection);
    } else {
        controller->in_session = 1;
        controller->opened_by = sequence;
        begin_answer(controller, &writer);
        write_description(controller, &writer, sequence);
        answer(controller, sequence, &writer);
    }
}

static void take_request(vc_controller *controller, const vc_message *message)
{
    vc_frame_writer writer;
    vc_rejection rejection;
    int rejected;
    if (!controller->in_session && message->type != VC_STOP) {
        vc_reject(&rejection, VC_HELLO_FIRST, "no session is open: say hello first");
        answer_error(controller, message->sequence, &rejection);
        return;
    }
    if (!is_new(controller, message->sequence))
        return;
    begin_answer(controller, &writer);
    rejected = dispatch(controller, message, &writer, &rejection);
    if (rejected)
        vc_write_rejection(&writer, message->sequence, &rejection);
    answer(controller, message->sequence, &writer);
    if (message->type == VC_FLASH_ACTIVATE && !rejected) {
        stop(controller);
        vc_image_store_boot(&controller->images);
        start_idle(controller);
    }
}

/* Takes the packets of a message with stream data. The last one says how the message came. */
static enum vc_arrival add_packets(vc_controller *controller, vc_stream_data *data)
{
    enum vc_arrival arrival = VC_IN_TURN;
    vc_piece packet;
    while (vc_next_item(&data->packets, &packet))
        arrival = vc_playback_add(&controller->playback, data->stream, data->iteration, packet, controller->time_us);
    return arrival;
}

/* Acts on a message and answers it; docs/reference/protocol.md, "Sequence numbers". */
static void handle(vc_controller *controller, vc_piece payload)
{
    vc_playback *playback = &controller->playback;
    enum vc_arrival arrival = VC_IN_TURN;
    vc_message message;
    vc_rejection rejection;
    int rejected;
    if (payload.bytes[0] >= VC_FIRST_FROM_CONTROLLER)
        return;
    controller->heard_us = controller->time_us;
    rejected = vc_message_read(&message, payload.bytes, payload.length, &rejection);
    if (!rejected && message.sequence == VC_NOTIFICATION && message.type < VC_FIRST_UNSEQUENCED)
        rejected = vc_reject(&rejection, VC_MALFORMED, "a request needs a sequence number of 1 or more");
    if (rejected && message.sequence == VC_NOTIFICATION) {
        if (outgoing_bytes(controller) < UNREAD_NOTIFICATIONS_BYTES)
            send_error(controller, VC_NOTIFICATION, &rejection);
    } else if (rejected) {
        if (is_new(controller, message.sequence))
            answer_error(controller, message.sequence, &rejection);
    } else if (message.type == VC_HELLO) {
        greet(controller, message.sequence, &message.body.hello);
    } else if (message.type == VC_POSITION) {
        if (controller->configured && controller->settings->position == NULL)
            arrival = vc_playback_position(playback, message.body.position.device_time_us,
                                           message.body.position.position_nm, controller->time_us);
    } else if (message.type == VC_SINGLE_PACKET) {
        if (controller->configured)
            arrival = vc_playback_add(playback, message.body.single_packet.stream, 0, message.body.single_packet.packet,
                                      controller->time_us);
    } else if (message.type != VC_STREAM_DATA) {
        take_request(controller, &message);
    } else if (controller->configured) {
        arrival = add_packets(controller, &message.body.stream_data);
    }
    if (arrival == VC_REPEATED)
        vc_count_one(&controller->frame_faults.repeated);
    else if (arrival == VC_REORDERED)
        vc_count_one(&controller->frame_faults.reordered);
}

/* ---- time ---- */

static int fits(const char *text, size_t most_bytes)
{
    size_t length = 0;
    while (length <= most_bytes && text[length] != 0)
        length++;
    return length <= most_bytes;
}

/* Whether the flash is as settings.h says, as far as that can be seen. */
static int is_usable_flash(const vc_flash *flash)
{
    const uint32_t unit = flash->write_bytes;
    const uint32_t places =
        flash->record[0] | flash->record[1] | flash->record_bytes | flash->slot[0] | flash->slot[1] | flash->slot_bytes;
    return flash->base != NULL && flash->erase != NULL && flash->program != NULL && unit > 0 &&
           unit <= VC_MOST_WRITE_BYTES && (unit & (unit - 1)) == 0 && places % unit == 0 &&
           flash->record_bytes >= VC_LEAST_RECORD_BYTES && flash->record[0] != flash->record[1] &&
           flash->slot_bytes > 0 && flash->slot[0] != flash->slot[1];
}

/* Whether the settings and the flash are as settings.h says, as far as that can be seen. */
static int are_usable(const vc_controller_settings *settings, const vc_flash *flash)
{
    return settings->build != NULL && settings->hardware != NULL && fits(settings->build, VC_TEXT_BYTES) &&
           fits(settings->hardware, VC_TEXT_BYTES) &&
           (settings->serial_number == NULL || fits(settings->serial_number, VC_SERIAL_NUMBER_BYTES)) &&
           settings->watchdog_ms >= VC_LEAST_WATCHDOG_MS && settings->actuator != NULL &&
           vc_actuator_is_usable(settings->actuator) && (flash == NULL || is_usable_flash(flash));
}

int vc_controller_init(vc_controller *controller, const vc_controller_settings *settings, const vc_flash *flash,
                       const vc_dac_port *dac, uint64_t now_us)
{
    if (!are_usable(settings, flash))
        return VC_BAD_SETTINGS;
    if (settings->public_key != NULL && settings->verify_signature == NULL)
        return VC_NO_VERIFIER;
    controller->settings = settings;
    controller->time_us = now_us;
    controller->dac_free_us = 0;
    controller->outgoing_at = controller->outgoing_end = 0;
    controller->playback.dac_port = dac;
    controller->playback.profile = settings->profile;
    controller->playback.sizes = vc_playback_sizes(settings);
    controller->playback.hand_delay_us = settings->position != NULL ? 0 : VC_HAND_DELAY_US;
    vc_frame_reader_init(&controller->reader);
    controller->frame_faults.repeated = controller->frame_faults.reordered = 0;
    vc_image_store_init(&controller->images, flash, settings, vc_tables_check, settings->callbacks);
    start_idle(controller);
    return VC_OK;
}

int vc_controller_advance(vc_controller *controller, uint64_t now_us)
{
    vc_playback *playback = &controller->playback;
    const uint64_t longest_us = (uint64_t)controller->settings->watchdog_ms * US_PER_MS;
    int behind;
    if (now_us > controller->time_us)
        controller->time_us = now_us;
    if (!controller->configured)
        return 0;
    if (controller->settings->position != NULL && is_active(playback->state))
        (void)vc_playback_position(
            playback, controller->time_us,
            controller->settings->position(controller->settings->position_context, controller->time_us),
            controller->time_us);
    if (is_active(playback->state) && controller->time_us - controller->heard_us > longest_us) {
        (void)vc_playback_advance(playback, controller->heard_us + longest_us);
        if (is_active(playback->state))
            vc_playback_stop(playback, VC_STATE_WATCHDOG);
    }
    if (is_active(playback->state) && playback->dac_port->has_failed != NULL &&
        playback->dac_port->has_failed(playback->dac_port->context))
        vc_playback_stop(playback, VC_STATE_FAULT);
    behind = vc_playback_advance(playback, controller->time_us);
    notify(controller);
    return behind;
}

int vc_controller_receive(vc_controller *controller, const uint8_t *data, size_t length, uint64_t now_us)
{
    int behind = vc_controller_advance(controller, now_us);
    while (length > 0) {
        vc_piece payload;
        const size_t taken = vc_frame_reader_feed(&controller->reader, data, length, &payload);
        if (payload.length > 0) {
            handle(controller, payload);
            behind = controller->configured;
        }
        data += taken;
        length -= taken;
    }
    notify(controller);
    return behind;
}
