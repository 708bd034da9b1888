/* Target: the decoder library over .vct files and links, with any memory; see vibrocast/decoder.h. */
#include <stdlib.h>
#include <string.h>

#include "../src/core/vc_crc.h"
#include "../src/core/vc_fields.h"
#include "targets.h"
#include "vibrocast/decoder.h"
#include "vibrocast/protocol.h"

enum { FILE_AS_IS, FILE_MENDED, LINK, KINDS };

/* Beyond these, one input takes long. */
#define MAX_PACKET_VALUES 65536u
#define MAX_VALUES 16384u

typedef struct {
    const uint8_t *bytes;
    size_t length, at;
} file;

typedef struct {
    vc_stream stream;
    file file;
    uint32_t polls; /* of each packet; 0: to its end */
    int16_t *samples;
    uint64_t played, values;
} player;

static size_t read_file(void *context, uint8_t *data, size_t length)
{
    file *from = context;
    if (length > from->length - from->at)
        length = from->length - from->at;
    if (length > 0)
        memcpy(data, from->bytes + from->at, length);
    from->at += length;
    return length;
}

static void *exactly(size_t length)
{
    return malloc(length > 0 ? length : 1);
}

static void check_status(int status, int least, int most)
{
    vc_fuzz_check(status >= least && status <= most && strcmp(vc_status_text(status), "unknown status") != 0,
                  "a status that the header does not name");
}

/* Opens the stream in too little memory, then in `memory_bytes`, 0: as much as it needs. Returns whether it plays. */
static int open_twice(player *player, size_t memory_bytes)
{
    vc_stream *stream = &player->stream;
    int status = vc_stream_open(stream);
    check_status(status, VC_CUT, -1);
    vc_fuzz_check(vc_stream_next(stream) == status && vc_stream_feed(stream, NULL, 0) == status,
                  "a stream that failed and goes on");
    vc_fuzz_check(vc_stream_poll(stream, NULL) == stream->packet_samples, "samples of a stream that failed");
    if (status != VC_TOO_SMALL)
        return 0;
    vc_fuzz_check(stream->needed_bytes > 0 && stream->needed_bytes <= VC_DECODER_WORDS * sizeof(int64_t),
                  "a decoder larger than VC_DECODER_WORDS");
    stream->memory_bytes = memory_bytes > 0 ? memory_bytes : stream->needed_bytes;
    stream->memory = exactly(stream->memory_bytes);
    player->file.at = 0;
    status = vc_stream_open(stream);
    vc_fuzz_check(status == (stream->memory_bytes < stream->needed_bytes ? VC_TOO_SMALL : VC_OK), "opened otherwise");
    vc_fuzz_check(stream->packet_samples > 0 && stream->channels >= 1 && stream->channels <= VC_MAX_CHANNELS,
                  "a stream out of range");
    return status == VC_OK && stream->packet_samples <= MAX_PACKET_VALUES / stream->channels;
}

/* Polls the packet. Returns whether further ones may be played. */
static int poll(player *player)
{
    vc_stream *stream = &player->stream;
    const uint32_t packet_samples = stream->packet_samples;
    uint32_t before = 0, now, polls = 0;
    vc_fuzz_check(stream->first <= stream->last && stream->last <= packet_samples, "a recording outside its packet");
    do {
        now = vc_stream_poll(stream, player->samples);
        vc_fuzz_check(now >= before && now <= packet_samples, "samples that are taken back, or too many");
        vc_fuzz_check(++polls <= packet_samples * stream->channels, "a packet without an end");
        before = now;
    } while (now < packet_samples && polls != player->polls);
    if (now == packet_samples)
        vc_fuzz_check(vc_stream_poll(stream, NULL) == packet_samples, "samples behind the packet");
    player->played += stream->last - stream->first;
    player->values += (uint64_t)packet_samples * stream->channels;
    return player->values < MAX_VALUES;
}

static void play_file(player *player)
{
    vc_stream *stream = &player->stream;
    int status;
    while ((status = vc_stream_next(stream)) == VC_OK)
        if (!poll(player))
            return;
    check_status(status, VC_CUT, VC_END);
    vc_fuzz_check(status != VC_CONCEALED, "a file with a packet that was concealed");
    vc_fuzz_check(status != VC_END || stream->samples == UINT64_MAX || player->played == stream->samples,
                  "a whole file without all of the recording");
    vc_fuzz_check(vc_stream_next(stream) == status, "a stream that ended and goes on");
    vc_fuzz_check(vc_stream_poll(stream, NULL) == stream->packet_samples, "samples behind the end");
}

static void play_link(player *player, const uint8_t *data, size_t length)
{
    uint8_t *packet, *before = NULL;
    size_t packet_length;
    int status, more = 1;
    while (more && vc_fuzz_record(&data, &length, &packet, &packet_length)) {
        status = vc_stream_feed(&player->stream, packet_length > 0 ? packet : NULL, packet_length);
        free(before); /* the packet before is no longer needed, whether or not it was polled to its end */
        before = packet;
        vc_fuzz_check(status == VC_CONCEALED || (packet_length > 0 && (status == VC_OK || status == VC_BAD_PACKET)),
                      "a status that vc_stream_feed does not return");
        more = poll(player);
    }
    free(before);
}

/* Puts a packet at the end of a file as vc_stream_next reads it: a byte of whether it is a refresh, and its payload.
 * Returns the bytes that it takes. */
static size_t put_packet(uint8_t *to, const uint8_t *record, size_t length, int one_packet, uint16_t *crc)
{
    const size_t payload = length - 1, head = 2 * payload + (record[0] & 1u);
    size_t at = 0;
    if (!one_packet) {
        to[at++] = (uint8_t)(head >> 14 | 0x80u);
        to[at++] = (uint8_t)((head >> 7 & 0x7Fu) | 0x80u);
        to[at++] = (uint8_t)(head & 0x7Fu);
    }
    if (payload > 0)
        memcpy(to + at, record + 1, payload);
    at += payload;
    *crc = vc_crc16(to, at, *crc);
    vc_number_bytes(to + at, *crc, 2);
    return at + 2;
}

/* Makes a file with checksums that are right of a header and packets, all in records. */
static uint8_t *mend(const uint8_t *data, size_t length, size_t *file_length)
{
    uint8_t *made = exactly(4 * length + 1), *record;
    size_t record_length, at = 0;
    uint16_t crc = VC_CRC16_START;
    int header = 1, one_packet = 0;
    while (vc_fuzz_record(&data, &length, &record, &record_length)) {
        if (header && record_length > 2) {
            memcpy(made, record, record_length);
            at = record_length;
            one_packet = (record[2] & VC_STREAM_ONE_PACKET) != 0;
            crc = vc_crc16(made, at, crc);
        } else if (record_length > 0) {
            at += put_packet(made + at, record, record_length, one_packet, &crc);
        }
        header = 0;
        free(record);
    }
    *file_length = at;
    return made;
}

void vc_fuzz_streams(const uint8_t *data, size_t length)
{
    player player;
    vc_fields fields;
    uint8_t *record, *model = NULL, *made = NULL;
    size_t record_length, memory_bytes, cut_bytes;
    unsigned kind;
    if (!vc_fuzz_record(&data, &length, &record, &record_length))
        return;
    memset(&player, 0xA5, sizeof player); /* a caller need not clear it */
    vc_fields_begin(&fields, record, record_length);
    kind = (unsigned)vc_take_number(&fields, 1) % KINDS;
    player.polls = (uint32_t)vc_take_number(&fields, 1);
    memory_bytes = (size_t)vc_take_number(&fields, 2);
    player.stream.packet_bytes = (size_t)vc_take_number(&fields, 2);
    cut_bytes = (size_t)vc_take_number(&fields, 2);
    free(record);
    (void)vc_fuzz_record(&data, &length, &model, &player.stream.model_bytes);
    player.stream.model = model != NULL && player.stream.model_bytes > 0 ? model : NULL;
    player.stream.packet = player.stream.packet_bytes > 0 ? malloc(player.stream.packet_bytes) : NULL;
    player.stream.read = read_file;
    player.stream.context = &player.file;
    player.stream.memory = NULL;
    player.stream.memory_bytes = 0;
    player.samples = NULL;
    player.played = player.values = player.file.at = player.file.length = 0;
    record = NULL;
    if (kind == LINK) {
        (void)vc_fuzz_record(&data, &length, &record, &player.file.length);
        player.file.bytes = record;
    } else if (kind == FILE_MENDED) {
        player.file.bytes = made = mend(data, length, &player.file.length);
    } else {
        player.file.bytes = data;
        player.file.length = length;
    }
    if (cut_bytes > 0 && cut_bytes < player.file.length)
        player.file.length = cut_bytes;
    if (open_twice(&player, memory_bytes)) {
        player.samples = malloc((size_t)player.stream.packet_samples * player.stream.channels * sizeof(int16_t));
        vc_fuzz_check(vc_stream_poll(&player.stream, NULL) == player.stream.packet_samples, "samples without a packet");
        if (kind == LINK)
            play_link(&player, data, length);
        else
            play_file(&player);
    }
    free(player.samples);
    free(player.stream.memory);
    free(player.stream.packet);
    free(record);
    free(made);
    free(model);
}
