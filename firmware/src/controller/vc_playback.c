/* One stream on the controller, and one behind it: buffers, decodes and plays them; see vc_playback.h. */
#include "vc_playback.h"

/* Limits for loops, because each iteration starts again and decodes padding. */
#define SHORTEST_ITERATION_MS 3u
#define DECODED_PER_PLAYED 16u
/* After this time without data, playing begins with the packets at hand: the rest of the prebuffer was lost. */
#define LONGEST_WAIT_US 1000000u
#define US_PER_S 1000000u
#define DISPLACEMENT 2 /* the unit um; output.h */

#define NO_END UINT64_MAX

static uint64_t least(uint64_t a, uint64_t b)
{
    return a < b ? a : b;
}

/* value * numerator / denominator, rounded down or up; numerator and denominator are at most 10^6. */
static uint64_t scaled(uint64_t value, uint32_t numerator, uint32_t denominator)
{
    return value / denominator * numerator + value % denominator * numerator / denominator;
}

static uint64_t scaled_up(uint64_t value, uint32_t numerator, uint32_t denominator)
{
    return value / denominator * numerator + (value % denominator * numerator + denominator - 1) / denominator;
}

/* ---- captures ---- */

static void capture(vc_capture *capture, const int16_t *samples, uint32_t count, unsigned channels)
{
    capture->end += count;
    if (count > capture->size) {
        samples += (size_t)(count - capture->size) * channels;
        count = capture->size;
    }
    while (count > 0) {
        const uint32_t piece = (uint32_t)least(count, capture->size - capture->at);
        memcpy(capture->samples + (size_t)capture->at * channels, samples, (size_t)piece * channels * sizeof *samples);
        capture->at += piece;
        if (capture->at == capture->size)
            capture->at = 0;
        samples += (size_t)piece * channels;
        count -= piece;
    }
}

void vc_playback_captured(const vc_playback *playback, enum vc_tap tap, uint64_t *offset, uint32_t count,
                          vc_run runs[2])
{
    const vc_capture *capture = &playback->captures[tap];
    const unsigned channels = playback->header.output.channels;
    const uint64_t oldest = capture->end - least(capture->end, capture->size);
    uint32_t behind, at;
    *offset = least(*offset > oldest ? *offset : oldest, capture->end);
    count = (uint32_t)least(count, capture->end - *offset);
    behind = (uint32_t)(capture->end - *offset);
    at = capture->at >= behind ? capture->at - behind : capture->at + capture->size - behind;
    runs[0].samples = capture->samples + (size_t)at * channels;
    runs[0].count = (uint32_t)least(count, capture->size - at);
    runs[1].samples = capture->samples;
    runs[1].count = count - runs[0].count;
}

/* ---- set up ---- */

/* Decoded samples of one iteration up to the recording's end; only padding follows. NO_END for a stream of unknown
 * length. */
static uint64_t recording_end(const vc_stream_header *header, const vc_coding *coding)
{
    return header->samples == VC_LENGTH_UNKNOWN ? NO_END : coding->delay_samples + header->samples;
}

static int is_spatial(const vc_stream_header *header)
{
    return header->output.unit == VC_UNIT_PROFILE;
}

/* Returns the stream as the drive takes it: a profile is rendered at the DAC's rate. */
static vc_output_stream output_of(const vc_stream_header *header, const vc_actuator *actuator)
{
    vc_output_stream output = header->output;
    if (is_spatial(header)) {
        output.unit = DISPLACEMENT;
        output.rate_hz = actuator->dac_rate_hz;
    }
    return output;
}

/* Rejects a profile that cannot be loaded as a whole or rendered. */
static int reject_profile(const vc_configure *configure, const vc_stream_header *header, const vc_coding *coding,
                          const vc_controller_settings *settings, vc_rejection *rejection)
{
    const uint32_t room = vc_playback_sizes(settings).profile_samples;
    /* An image's actuator has the same rate. */
    const uint32_t least_samples = vc_profile_least_samples(header->output.rate_hz, settings->actuator->dac_rate_hz);
    if (header->samples == VC_LENGTH_UNKNOWN || configure->first_packet > 0 ||
        (uint64_t)configure->packets * coding->packet_samples < coding->delay_samples + header->samples)
        return vc_reject(rejection, VC_BAD_VALUE,
                         "a profile is loaded as a whole: its header says its length, and its packets hold all of it");
    if (header->samples > room / header->output.channels)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS,
                                 "a profile of # samples; there is room for # in all channels together",
                                 header->samples, room);
    if (least_samples == 0 || header->samples < least_samples)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS,
                                 "a profile of # samples; at its pitch it needs # to be rendered at 300 mm/s",
                                 header->samples, least_samples);
    return 0;
}

static int reject_short_iterations(const vc_stream_header *header, const vc_coding *coding, uint32_t packets,
                                   vc_rejection *rejection)
{
    const uint64_t decoded = (uint64_t)packets * coding->packet_samples;
    const uint64_t end = least(decoded, recording_end(header, coding));
    const uint64_t played = end - least(end, coding->delay_samples);
    if (is_spatial(header))
        return vc_reject(rejection, VC_BAD_VALUE, "a profile repeats by itself as the hand goes on: loops is 1");
    if (packets == 0)
        return vc_reject(rejection, VC_BAD_VALUE, "a live stream cannot loop");
    if (played * 1000 < (uint64_t)SHORTEST_ITERATION_MS * header->output.rate_hz ||
        played * DECODED_PER_PLAYED < decoded)
        return vc_reject_numbers(rejection, VC_BAD_VALUE,
                                 "an iteration would play # of the # samples in its packets, too few or too small a "
                                 "part to be repeated: send a longer one that holds several repeats",
                                 played, decoded);
    return 0;
}

/* The number of packets of a stream that fit the buffer's samples. */
static uint32_t buffer_packets_of(const vc_coding *coding, const vc_sizes *sizes)
{
    return (uint32_t)least(VC_BUFFER_PACKETS, sizes->buffer_samples / coding->packet_samples);
}

vc_sizes vc_playback_sizes(const vc_controller_settings *settings)
{
    const vc_sizes *asked = settings->sizes;
    vc_sizes sizes = {VC_CHANNELS, VC_BUFFER_SAMPLES, VC_CAPTURE_SAMPLES, VC_PROFILE_SAMPLES};
    if (asked != NULL) {
        sizes.channels = (uint8_t)least(sizes.channels, asked->channels);
        sizes.buffer_samples = (uint32_t)least(sizes.buffer_samples, asked->buffer_samples);
        sizes.capture_samples = (uint32_t)least(sizes.capture_samples, asked->capture_samples);
        sizes.profile_samples = (uint32_t)least(sizes.profile_samples, asked->profile_samples);
    }
    if (settings->profile == NULL)
        sizes.profile_samples = 0;
    return sizes;
}

uint32_t vc_playback_max_rate_hz(const vc_actuator *actuator)
{
    return (uint32_t)least(VC_MAX_RATE_HZ, (uint64_t)VC_RATE_RATIO * actuator->dac_rate_hz);
}

int vc_playback_check(const vc_configure *configure, const vc_stream_header *header, vc_coding *coding,
                      const vc_controller_settings *settings, const vc_actuator *actuator, vc_rejection *rejection)
{
    const vc_output_stream output = output_of(header, actuator);
    const uint32_t max_rate_hz = vc_playback_max_rate_hz(actuator);
    const vc_sizes sizes = vc_playback_sizes(settings);
    uint64_t end, room, kilocycles_per_s;
    if (configure->packets > 0 && configure->first_packet >= configure->packets)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "packet # of # cannot be the first", configure->first_packet,
                                 configure->packets);
    if (output.channels > sizes.channels)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS, "# channels; there are # here", output.channels,
                                 sizes.channels);
    if (!is_spatial(header) && (output.rate_hz < VC_MIN_RATE_HZ || output.rate_hz > max_rate_hz))
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS, "a rate outside # to # Hz: resample first",
                                 VC_MIN_RATE_HZ, max_rate_hz);
    if (vc_coding_check(coding, settings->callbacks, rejection))
        return rejection->code;
    if (vc_drive_size(actuator, &output) == 0)
        return vc_reject(rejection, VC_BEYOND_LIMITS, "the output cannot play a stream of this kind");
    kilocycles_per_s = (uint64_t)coding->cycles_per_sample * output.rate_hz / 1000;
    end = recording_end(header, coding);
    if (end != NO_END && (uint64_t)configure->packets * coding->packet_samples >= end + 2 * coding->packet_samples)
        return vc_reject_numbers(rejection, VC_BAD_VALUE,
                                 "# packets are too many for the # samples that the stream header announces",
                                 configure->packets, header->samples);
    if (coding->packet_samples > VC_PACKET_SAMPLES)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS,
                                 "packets of # samples; here they have at most #: encode with shorter packets",
                                 coding->packet_samples, VC_PACKET_SAMPLES);
    if (!is_spatial(header) && settings->decoding_kilocycles_per_s > 0 &&
        kilocycles_per_s > settings->decoding_kilocycles_per_s)
        return vc_reject_numbers(rejection, VC_BEYOND_LIMITS,
                                 "decoding may take # thousand cycles a second; there is time for # here: use fewer "
                                 "channels, a lower rate, or a codec that takes less",
                                 kilocycles_per_s, settings->decoding_kilocycles_per_s);
    room = (uint64_t)buffer_packets_of(coding, &sizes) * coding->packet_samples;
    if (room == 0 || configure->prebuffer_samples > room)
        return vc_reject_numbers(
            rejection, VC_BEYOND_LIMITS,
            "a prebuffer of # samples; the buffer has room for # samples in packets of this stream",
            configure->prebuffer_samples, room);
    if (is_spatial(header) && reject_profile(configure, header, coding, settings, rejection))
        return rejection->code;
    return configure->loops == 1 ? 0 : reject_short_iterations(header, coding, configure->packets, rejection);
}

static vc_drive *drive_of(vc_playback *playback)
{
    return (vc_drive *)playback->drive;
}

static const vc_drive *const_drive_of(const vc_playback *playback)
{
    return (const vc_drive *)playback->drive;
}

/* Takes over what describes a stream. */
static void describe(vc_playback *playback, uint8_t stream, const vc_stream_header *header, const vc_coding *coding,
                     uint32_t packets, uint16_t loops)
{
    playback->header = *header;
    playback->coding = *coding;
    playback->coding.configuration = playback->header.configuration;
    playback->spatial = (uint8_t)is_spatial(header);
    playback->stream = stream;
    playback->live = playback->open = packets == 0;
    playback->packets = packets;
    playback->loops = loops;
    playback->buffer_packets = buffer_packets_of(&playback->coding, &playback->sizes);
    playback->position = 0;
    playback->has_next = 0;
    vc_decoder_init(&playback->decoder, &playback->coding);
}

/* The length of a packet; no limit for a profile, whose packets have none. */
static uint32_t packet_us(const vc_playback *playback)
{
    return playback->spatial
               ? UINT32_MAX
               : (uint32_t)least((uint64_t)playback->coding.packet_samples * 1000000 / playback->output.rate_hz,
                                 UINT32_MAX);
}

void vc_playback_init(vc_playback *playback, const vc_configure *configure, const vc_stream_header *header,
                      const vc_coding *coding)
{
    uint32_t delay_samples, hold_samples;
    unsigned tap;
    describe(playback, configure->stream, header, coding, configure->packets, configure->loops);
    playback->output = output_of(header, playback->actuator);
    playback->prebuffer_samples = configure->prebuffer_samples;
    playback->key = 0;
    playback->joins = 0;

    playback->state = VC_STATE_BUFFERING;
    playback->next = playback->newest_end = configure->first_packet;
    playback->position = playback->next * playback->coding.packet_samples;
    playback->start_us = playback->waiting_since_us = playback->rest_from_us = 0;
    playback->clock_from_us = playback->clock_samples = 0;
    playback->starved = 0;
    playback->underruns = playback->lost_packets = 0;

    vc_packet_buffer_clear(&playback->buffer);
    playback->decoding = playback->behind = 0;
    playback->decoded_samples = playback->decoded_at = playback->decoded_end = 0;
    playback->decoded_for_drive = playback->played = 0;
    playback->finishing = playback->drained = 0;
    playback->drive_at = playback->drive_end = 0;
    playback->ramping = 0;
    if (playback->spatial)
        vc_profile_init(playback->profile, header->output.rate_hz, (uint32_t)header->samples, header->output.channels,
                        playback->actuator->dac_rate_hz);
    delay_samples = playback->spatial ? 0 : coding->delay_samples;
    (void)vc_drive_init(drive_of(playback), playback->actuator, &playback->output, configure->compensation,
                        delay_samples);
    hold_samples = vc_drive_samples(drive_of(playback), delay_samples);
    vc_dac_init(&playback->dac, playback->actuator, &playback->output, configure->gain_float_bits,
                configure->compensation, hold_samples);
    if (playback->dac_port->begin != NULL)
        playback->dac_port->begin(playback->dac_port->context, packet_us(playback));
    if (playback->dac_port->count != NULL)
        playback->dac_port->count(playback->dac_port->context, &playback->counts_before);
    for (tap = 0; tap < 2; tap++) {
        playback->captures[tap].size = playback->sizes.capture_samples;
        playback->captures[tap].end = playback->captures[tap].at = 0;
    }
}

/* ---- packets ---- */

/* The number of all packets, NO_END while it is open. */
static uint64_t end_of(const vc_playback *playback)
{
    const uint64_t in_iteration = playback->packets > 0 ? playback->packets : 1;
    const uint64_t begun = (playback->next > 0 ? playback->next - 1 : 0) / in_iteration + 1;
    if (playback->open || playback->loops == 0)
        return NO_END;
    return playback->packets * (playback->loops > begun ? playback->loops : begun);
}

/* The packet before which data may be sent. The buffer's samples have room for as many; its bytes have, however long
 * the missing packets are. */
static uint64_t credit_of(const vc_playback *playback)
{
    const vc_packet_buffer *buffer = &playback->buffer;
    return playback->next + least(playback->buffer_packets, buffer->count + vc_packet_buffer_room(buffer));
}

uint32_t vc_playback_capacity_samples(const vc_playback *playback)
{
    return (uint32_t)least(playback->buffer_packets, VC_BUFFER_BYTES / VC_MAX_PACKET_BYTES) *
           playback->coding.packet_samples;
}

/* Begins to decode the next packet, or to conceal its loss. */
static void begin_packet(vc_playback *playback)
{
    const vc_coding *coding = &playback->coding;
    const uint64_t number = playback->next++;
    const uint64_t iteration = playback->open ? 0 : number / playback->packets;
    const uint64_t before = (number - iteration * playback->packets) * coding->packet_samples;
    const uint64_t end = playback->live ? NO_END : recording_end(&playback->header, coding);
    size_t length;
    const uint8_t *packet;
    int starved;
    if (iteration > 0 && before == 0) {
        vc_decoder_init(&playback->decoder, &playback->coding);
        vc_drive_join(drive_of(playback));
    }
    packet = vc_packet_buffer_find(&playback->buffer, playback->key + number, &length);
    starved = playback->newest_end <= number;
    if (starved && !playback->starved)
        vc_count_one(&playback->underruns);
    playback->starved = starved;
    if (packet != NULL) /* later packets may take its place in the buffer before it is decoded */
        memcpy(playback->packet, packet, length);
    if (packet == NULL || !vc_decoder_feed(&playback->decoder, playback->packet, length)) {
        vc_count_one(&playback->lost_packets);
        (void)vc_decoder_feed(&playback->decoder, NULL, 0);
    }
    vc_packet_buffer_remove(&playback->buffer, playback->key + number);
    playback->decoding = 1;
    playback->decoded_samples = 0;
    /* Iterations join without a gap: a later one begins after the codec's delay, and each ends with the recording. */
    playback->decoded_at = 0;
    if ((iteration > 0 || playback->spatial || playback->joins) && before < coding->delay_samples)
        playback->decoded_at = (uint32_t)least(coding->delay_samples - before, coding->packet_samples);
    playback->decoded_end = (uint32_t)least(end - least(end, before), coding->packet_samples);
    if (playback->decoded_end < playback->decoded_at)
        playback->decoded_end = playback->decoded_at;
    playback->decoded_for_drive += playback->decoded_end - playback->decoded_at;
}

/* Goes on with the stream behind the one that has been decoded to its end, as with a further iteration. */
static void begin_next(vc_playback *playback)
{
    playback->key += end_of(playback);
    playback->next = 0;
    playback->newest_end = playback->next_newest_end;
    playback->joins = 1;
    describe(playback, playback->queued.stream, &playback->next_header, &playback->next_coding, playback->next_packets,
             playback->next_loops);
    vc_drive_join(drive_of(playback));
}

/* Decodes the next block. Returns 0, and does nothing, if this turn has decoded one already. */
static int decode_block(vc_playback *playback)
{
    const unsigned channels = playback->header.output.channels;
    uint32_t before;
    if (playback->polled) {
        playback->behind = 1;
        return 0;
    }
    if (!playback->decoding)
        begin_packet(playback);
    before = playback->decoded_samples;
    playback->polled = 1;
    playback->decoded_samples = vc_decoder_poll(&playback->decoder, playback->decoded);
    playback->decoding = playback->decoded_samples < playback->coding.packet_samples;
    capture(&playback->captures[VC_TAP_DECODED], playback->decoded + (size_t)before * channels,
            playback->decoded_samples - before, channels);
    return 1;
}

/* Returns how many decoded samples the drive can take now. */
static uint32_t takeable(const vc_playback *playback)
{
    const uint32_t end = (uint32_t)least(playback->decoded_samples, playback->decoded_end);
    return end > playback->decoded_at ? end - playback->decoded_at : 0;
}

static int has_packet(const vc_playback *playback)
{
    size_t length;
    return vc_packet_buffer_find(&playback->buffer, playback->key + playback->next, &length) != NULL;
}

/* Decodes the next block of a profile into it, if its packet is there. Returns whether the profile is whole. */
static int load_block(vc_playback *playback)
{
    uint32_t samples;
    int making;
    if (playback->decoding || has_packet(playback))
        (void)decode_block(playback);
    samples = takeable(playback);
    making =
        vc_profile_load(playback->profile,
                        playback->decoded + (size_t)playback->decoded_at * playback->header.output.channels, samples);
    playback->decoded_at += samples;
    playback->behind = playback->decoding || has_packet(playback) || making;
    return playback->next == playback->packets && !playback->decoding && !making;
}

/* The packets of the next stream that credit reaches. */
static uint64_t next_credit_of(const vc_playback *playback)
{
    const uint64_t credit = credit_of(playback), end = end_of(playback);
    const uint64_t most = buffer_packets_of(&playback->next_coding, &playback->sizes);
    return credit > end ? least(credit - end, most) : 0;
}

static int rejects_other_format(const vc_output_stream *one, const vc_output_stream *other)
{
    unsigned channel;
    if (one->rate_hz != other->rate_hz || one->unit != other->unit || one->channels != other->channels)
        return 1;
    for (channel = 0; channel < one->channels; channel++)
        if (one->gain[channel] != other->gain[channel])
            return 1;
    return 0;
}

int vc_playback_queue(vc_playback *playback, const vc_configure *configure, const vc_stream_header *header,
                      const vc_coding *coding, vc_rejection *rejection)
{
    if (playback->has_next || playback->finishing || playback->spatial || end_of(playback) == NO_END)
        return vc_reject(rejection, VC_WRONG_STATE,
                         "a stream is queued before the end of one that ends, and that has none behind it yet");
    if (configure->stream == playback->stream)
        return vc_reject_numbers(rejection, VC_BAD_VALUE, "stream # plays: give the next one another number",
                                 configure->stream, 0);
    if (configure->packets == 0 || configure->first_packet > 0)
        return vc_reject(rejection, VC_BAD_VALUE, "a queued stream has a known number of packets, from the first on");
    if (rejects_other_format(&playback->header.output, &header->output))
        return vc_reject(rejection, VC_BEYOND_LIMITS,
                         "a queued stream has the rate, channels, unit and full scales of the one before: wait for its "
                         "end instead");
    playback->has_next = 1;
    playback->queued.stream = configure->stream;
    playback->next_header = *header;
    playback->next_coding = *coding;
    playback->next_coding.configuration = playback->next_header.configuration;
    playback->next_packets = configure->packets;
    playback->next_loops = configure->loops;
    playback->next_newest_end = 0;
    return 0;
}

enum vc_arrival vc_playback_add(vc_playback *playback, uint8_t stream, uint32_t iteration, vc_piece packet,
                                uint64_t time_us)
{
    const int is_next = playback->has_next && stream == playback->queued.stream;
    const uint32_t packets = is_next ? playback->next_packets : playback->packets;
    uint64_t *newest_end = is_next ? &playback->next_newest_end : &playback->newest_end;
    enum vc_arrival arrival = VC_IN_TURN;
    uint64_t number, key, end;
    uint32_t sequence;
    size_t length;
    int refresh, late;
    if ((stream != playback->stream && !is_next) || playback->state < VC_STATE_BUFFERING ||
        playback->state > VC_STATE_PAUSED || packet.length > VC_MAX_PACKET_BYTES ||
        vc_packet_sequence(packet.bytes, packet.length, &sequence, &refresh) != 0 ||
        (playback->open ? iteration > 0 : sequence >= packets))
        return VC_IN_TURN;
    number = (uint64_t)iteration * packets + sequence;
    end = is_next ? (playback->next_loops == 0 ? NO_END : (uint64_t)playback->next_loops * packets) : end_of(playback);
    if (number >= (is_next ? next_credit_of(playback) : credit_of(playback)) || number >= end)
        return VC_IN_TURN;
    late = !is_next && number < playback->next;
    key = playback->key + (is_next ? end_of(playback) : 0) + number;
    if (number >= *newest_end)
        *newest_end = number + 1;
    else if (number + 1 == *newest_end || (!late && vc_packet_buffer_find(&playback->buffer, key, &length) != NULL))
        arrival = VC_REPEATED; /* a copy comes right behind its packet, or while that waits */
    else
        arrival = VC_REORDERED;
    if (late)
        return arrival;
    (void)vc_packet_buffer_add(&playback->buffer, key, packet.bytes, packet.length);
    if (!is_next)
        playback->waiting_since_us = time_us;
    return arrival;
}

enum vc_arrival vc_playback_position(vc_playback *playback, uint64_t hand_us, int64_t position_nm, uint64_t time_us)
{
    enum vc_arrival arrival = VC_IN_TURN;
    if (!playback->spatial || playback->state < VC_STATE_BUFFERING || playback->state > VC_STATE_PAUSED)
        return arrival;
    if (hand_us > 0 && hand_us <= vc_profile_newest_us(playback->profile))
        arrival = hand_us == vc_profile_newest_us(playback->profile) ? VC_REPEATED : VC_REORDERED;
    if (vc_profile_position(playback->profile, hand_us > 0 ? least(hand_us, time_us) : time_us, position_nm))
        vc_count_one(&playback->underruns);
    return arrival;
}

/* ---- requests of the host ---- */

static void ramp_down(vc_playback *playback)
{
    if (!playback->ramping)
        vc_dac_begin_ramp(&playback->dac);
    playback->ramping = 1;
}

void vc_playback_start(vc_playback *playback, uint64_t start_us, uint64_t time_us)
{
    playback->state = VC_STATE_ARMED;
    playback->start_us = start_us > time_us ? start_us : time_us;
    playback->waiting_since_us = time_us;
}

void vc_playback_pause(vc_playback *playback)
{
    playback->state = VC_STATE_PAUSED;
    ramp_down(playback);
}

void vc_playback_resume(vc_playback *playback)
{
    playback->state = VC_STATE_PLAYING;
    if (playback->spatial)
        vc_profile_begin(playback->profile);
}

void vc_playback_stop(vc_playback *playback, enum vc_state state)
{
    if (playback->state == VC_STATE_PLAYING)
        ramp_down(playback);
    playback->state = state;
    if (playback->dac_port->drop != NULL)
        playback->dac_port->drop(playback->dac_port->context);
    vc_packet_buffer_clear(&playback->buffer);
    playback->has_next = 0;
    playback->decoding = 0;
    playback->decoded_samples = playback->decoded_at = playback->decoded_end = 0;
    playback->drive_at = playback->drive_end = 0;
}

int vc_playback_set_loops(vc_playback *playback, uint16_t loops, vc_rejection *rejection)
{
    const uint32_t packets = playback->live ? 0 : playback->packets;
    int rejected;
    if (playback->has_next)
        return vc_reject(rejection, VC_WRONG_STATE, "a stream is queued: the one under way no longer changes its end");
    rejected = loops == 1 ? 0 : reject_short_iterations(&playback->header, &playback->coding, packets, rejection);
    if (!rejected)
        playback->loops = loops;
    return rejected;
}

void vc_playback_set_gain(vc_playback *playback, uint32_t gain_float_bits)
{
    vc_dac_set_gain(&playback->dac, gain_float_bits);
}

void vc_playback_end_live(vc_playback *playback, uint32_t packets)
{
    playback->open = 0;
    playback->packets = packets > playback->next ? packets : (uint32_t)least(playback->next, UINT32_MAX);
}

/* ---- playing ---- */

/* Makes drive samples if none are left, and decodes a block for them; returns how many samples the DAC may take. */
static uint32_t ready_drive(vc_playback *playback)
{
    const unsigned channels = playback->header.output.channels;
    while (playback->drive_at == playback->drive_end && !playback->drained) {
        const int full = playback->drive_end == VC_PIECE_SAMPLES; /* the last push may have more */
        const uint32_t samples = takeable(playback);
        playback->drive_at = playback->drive_end = 0;
        if (playback->finishing) {
            playback->drive_end = vc_drive_finish(drive_of(playback), playback->drive_samples, VC_PIECE_SAMPLES);
            playback->drained = playback->drive_end == 0;
        } else if (full || samples > 0) {
            playback->decoded_at +=
                vc_drive_push(drive_of(playback), playback->decoded + (size_t)playback->decoded_at * channels, samples,
                              playback->drive_samples, VC_PIECE_SAMPLES, &playback->drive_end);
        } else if (!playback->decoding && playback->next >= end_of(playback)) {
            if (playback->has_next)
                begin_next(playback);
            else
                playback->finishing = 1;
        } else if (!decode_block(playback)) {
            break;
        }
    }
    return playback->drive_end - playback->drive_at;
}

/* Makes drive samples, at most `samples` and VC_PIECE_SAMPLES: the heights under the hand at the times of the next DAC
 * samples. */
static uint32_t render(vc_playback *playback, uint32_t samples)
{
    const unsigned channels = playback->header.output.channels;
    int16_t heights[VC_PIECE_SAMPLES * VC_CHANNELS];
    uint32_t n;
    for (n = 0; n < samples; n++) {
        const uint64_t time_us =
            playback->clock_from_us + scaled(playback->clock_samples + n, US_PER_S, playback->actuator->dac_rate_hz);
        vc_profile_render(playback->profile, time_us - least(time_us, playback->hand_delay_us),
                          heights + (size_t)n * channels);
    }
    playback->drive_at = 0;
    (void)vc_drive_push(drive_of(playback), heights, samples, playback->drive_samples, VC_PIECE_SAMPLES,
                        &playback->drive_end);
    return playback->drive_end;
}

/* Decoded samples that are not yet played, at the stream's rate. */
static uint32_t pending_samples(const vc_playback *playback)
{
    const uint32_t rate_hz = playback->header.output.rate_hz, dac_rate_hz = playback->actuator->dac_rate_hz;
    const uint64_t held = playback->finishing ? vc_drive_delay_samples(const_drive_of(playback)) : 0;
    const uint64_t drive = scaled_up(playback->decoded_for_drive + held, dac_rate_hz, rate_hz) - playback->played;
    if (playback->spatial || (playback->state != VC_STATE_PLAYING && playback->state != VC_STATE_PAUSED))
        return 0;
    return (uint32_t)scaled_up(drive, rate_hz, dac_rate_hz);
}

/* `loaded`: a profile is whole. */
static void begin_if_ready(vc_playback *playback, int loaded, uint64_t time_us)
{
    const uint64_t buffered = (playback->newest_end - playback->next) * playback->coding.packet_samples;
    const int full = credit_of(playback) - playback->next == playback->buffer.count;
    const int waits = playback->spatial
                          ? !loaded
                          : buffered < playback->prebuffer_samples && playback->newest_end != end_of(playback) &&
                                !full && time_us - playback->waiting_since_us <= LONGEST_WAIT_US;
    if (waits) {
        /* The prebuffer is late: playing begins when it is there. */
        if (playback->start_us < time_us)
            playback->start_us = time_us;
    } else if (playback->start_us <= time_us) {
        playback->state = VC_STATE_PLAYING;
        playback->clock_from_us = playback->start_us;
        playback->clock_samples = 0;
    }
}

/* Puts out codes that were due at `due_us`, at most `samples` and VC_PIECE_SAMPLES; returns how many, 0 at rest or
 * where the next block is left to the next turn. */
static uint32_t play(vc_playback *playback, uint64_t samples, uint64_t due_us)
{
    const unsigned channels = playback->header.output.channels;
    const uint32_t wanted = (uint32_t)least(samples, VC_PIECE_SAMPLES);
    int16_t codes[VC_PIECE_SAMPLES * VC_CHANNELS];
    uint32_t made = 0;
    if (playback->ramping) {
        made = vc_dac_ramp(&playback->dac, codes, wanted);
        playback->ramping = made > 0;
    }
    if (made == 0 && playback->state == VC_STATE_PLAYING) {
        made = playback->spatial ? render(playback, wanted) : (uint32_t)least(wanted, ready_drive(playback));
        if (made > 0) {
            vc_dac_play(&playback->dac, playback->drive_samples + (size_t)playback->drive_at * channels, made, codes);
            playback->drive_at += made;
            playback->played += made;
        } else if (!playback->behind && !vc_dac_at_rest(&playback->dac)) {
            ramp_down(playback);
            made = vc_dac_ramp(&playback->dac, codes, wanted);
        }
    }
    if (made > 0) {
        capture(&playback->captures[VC_TAP_DAC], codes, made, channels);
        playback->dac_port->play(playback->dac_port->context, codes, made, channels, due_us);
    }
    return made;
}

/* The time at which the next sample of the DAC is due. */
static uint64_t due_us_of(const vc_playback *playback)
{
    return playback->clock_from_us + scaled(playback->clock_samples, US_PER_S, playback->actuator->dac_rate_hz);
}

int vc_playback_advance(vc_playback *playback, uint64_t time_us)
{
    unsigned pieces = 0;
    uint64_t due, begun;
    int loaded = 0;
    playback->polled = playback->behind = 0;
    if (playback->spatial && playback->state >= VC_STATE_BUFFERING && playback->state <= VC_STATE_PAUSED)
        loaded = load_block(playback);
    if (playback->state == VC_STATE_ARMED)
        begin_if_ready(playback, loaded, time_us);
    begun = playback->clock_samples;
    due = scaled(time_us - playback->clock_from_us, playback->actuator->dac_rate_hz, US_PER_S) - begun;
    while (due > 0) {
        const uint32_t made = pieces < VC_TURN_PIECES ? play(playback, due, due_us_of(playback)) : 0;
        if (made == 0)
            break;
        due -= made;
        playback->clock_samples += made;
        pieces++;
    }
    playback->behind |= due > 0 && pieces == VC_TURN_PIECES;
    if (playback->clock_samples > begun)
        playback->rest_from_us =
            playback->clock_from_us + scaled_up(playback->clock_samples, US_PER_S, playback->actuator->dac_rate_hz);
    if (due > 0 && !playback->behind) { /* at rest: no samples are due later for this time */
        playback->clock_from_us = time_us;
        playback->clock_samples = 0;
        if (playback->state == VC_STATE_PLAYING) {
            playback->state = VC_STATE_FINISHED;
            vc_packet_buffer_clear(&playback->buffer);
        }
    }
    return playback->behind;
}

void vc_playback_flush(vc_playback *playback, uint64_t time_us)
{
    uint64_t samples = 0;
    uint32_t made;
    do {
        made = play(playback, VC_PIECE_SAMPLES, time_us);
        samples += made;
    } while (made > 0);
    if (samples > 0)
        playback->rest_from_us = time_us + scaled_up(samples, US_PER_S, playback->actuator->dac_rate_hz);
}

uint64_t vc_playback_free_us(const vc_playback *playback)
{
    return playback->rest_from_us +
           scaled_up(vc_dac_recovery_samples(&playback->dac), US_PER_S, playback->actuator->dac_rate_hz);
}

/* Packets of this stream that wait to be decoded. The buffer may hold those of the stream behind it, too. */
static uint32_t waiting_packets(const vc_playback *playback)
{
    uint32_t waiting = 0;
    uint64_t number;
    size_t length;
    for (number = playback->next; number < playback->newest_end; number++)
        waiting += vc_packet_buffer_find(&playback->buffer, playback->key + number, &length) != NULL;
    return waiting;
}

void vc_playback_report(vc_playback *playback, vc_status_report *status)
{
    const uint32_t pending = pending_samples(playback), packet_samples = playback->coding.packet_samples;
    const uint64_t reached = playback->next - (playback->spatial && playback->decoding);
    const vc_limit_counts *limited = vc_dac_counts(&playback->dac);
    vc_output_counts counts = playback->counts_before;
    if (playback->dac_port->count != NULL)
        playback->dac_port->count(playback->dac_port->context, &counts);
    if (reached * packet_samples > playback->position + pending)
        playback->position = reached * packet_samples - pending;
    status->state = (uint8_t)playback->state;
    status->stream = playback->stream;
    status->position = playback->position;
    status->credit_until = credit_of(playback) * packet_samples;
    status->queued = NULL;
    if (playback->has_next) {
        playback->queued.credit_until = next_credit_of(playback) * playback->next_coding.packet_samples;
        status->queued = &playback->queued;
    }
    status->buffered_samples = waiting_packets(playback) * packet_samples + pending;
    status->underruns = playback->underruns;
    status->lost_packets = playback->lost_packets;
    status->compensation_clipped = limited->compensation_clipped;
    status->voltage_limited = limited->voltage_limited;
    status->slew_limited = limited->slew_limited;
    status->power_limited = limited->power_limited;
    status->output_gaps = counts.gaps - playback->counts_before.gaps;
    status->late_samples = counts.late_samples - playback->counts_before.late_samples;
    playback->faults.refused = counts.refused - playback->counts_before.refused;
    playback->faults.restarts = counts.restarts - playback->counts_before.restarts;
    status->output_faults = playback->faults.refused || playback->faults.restarts ? &playback->faults : NULL;
}
