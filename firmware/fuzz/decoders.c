/* Targets: the decoder of each codec, over streams with any configuration and any model. */
#include <stdlib.h>
#include <string.h>

#include "../src/core/vc_codec.h"
#include "../src/core/vc_decoder_memory.h"
#include "targets.h"
#include "../src/core/vc_mdct.h"

/* Beyond these, a controller takes no stream, or one input takes long. */
#define MAX_PACKET_SAMPLES 4096u
#define MAX_SAMPLES 4096u
/* Longer than any decoder sounds after its last packet. This takes long as well: one input in SILENT_INPUTS does it. */
#define SILENT_AFTER_SAMPLES 1024u
#define SILENT_AFTER_PACKETS 3u
#define SILENT_INPUTS 16u

typedef struct {
    const vc_codec *codec;
    vc_coding coding;
    void *decoder;
    int16_t *samples, *complete; /* of a packet; complete: as they were when the decoder counted them as complete */
    uint64_t hash;               /* of all samples so far: FNV-1a, by Fowler, Noll and Vo */
    int by_blocks;               /* as controllers decode; else as the Python package does */
} player;

static void put(player *player, size_t values)
{
    size_t i;
    for (i = 0; i < values; i++)
        player->hash = (player->hash ^ (uint16_t)player->samples[i]) * 0x100000001B3u;
}

static int decode_by_blocks(player *player, const uint8_t *packet, size_t length)
{
    const size_t channels = player->coding.channels;
    const uint32_t packet_samples = player->coding.packet_samples;
    const int status = player->codec->feed(player->decoder, packet, length);
    uint32_t before = 0, now, polls = 0;
    if (status < 0)
        return status;
    for (; before < packet_samples; before = now) {
        now = player->codec->poll(player->decoder, player->samples);
        vc_fuzz_check(now >= before && now <= packet_samples, "samples that are taken back, or too many");
        vc_fuzz_check(++polls <= packet_samples * channels, "a packet without an end");
        memcpy(player->complete + before * channels, player->samples + before * channels,
               (now - before) * channels * sizeof *player->samples);
    }
    vc_fuzz_check(memcmp(player->complete, player->samples, packet_samples * channels * sizeof *player->samples) == 0,
                  "samples that change after they were complete");
    return status;
}

static int decode(player *player, const uint8_t *packet, size_t length)
{
    const uint32_t packet_samples = player->coding.packet_samples;
    const int status = player->by_blocks ? decode_by_blocks(player, packet, length)
                                         : vc_codec_decode(player->codec, player->decoder, packet_samples, packet,
                                                           length, player->samples);
    if (status >= 0)
        put(player, (size_t)packet_samples * player->coding.channels);
    return status;
}

static void check_silence(player *player)
{
    const size_t values = (size_t)player->coding.packet_samples * player->coding.channels;
    uint32_t packets = SILENT_AFTER_PACKETS + SILENT_AFTER_SAMPLES / player->coding.packet_samples;
    size_t i;
    while (packets-- > 0)
        vc_fuzz_check(decode(player, NULL, 0) == VC_CONCEALED, "a missing packet that is not concealed");
    for (i = 0; i < values; i++)
        vc_fuzz_check(player->samples[i] == 0, "a stream that sounds after its end");
}

/* Decodes a whole stream in memory that may have held another one. */
static uint64_t play(player *player, const uint8_t *data, size_t length)
{
    uint32_t left = MAX_SAMPLES / player->coding.packet_samples;
    uint8_t *packet;
    size_t packet_length;
    uint64_t packets_hash;
    player->hash = 0xCBF29CE484222325u;
    player->codec->init(player->decoder, &player->coding);
    while (left-- > 0 && vc_fuzz_record(&data, &length, &packet, &packet_length)) {
        if (packet_length == 0 || decode(player, packet, packet_length) < 0)
            vc_fuzz_check(decode(player, NULL, 0) == VC_CONCEALED, "a missing packet that is not concealed");
        free(packet);
    }
    packets_hash = player->hash;
    if (player->by_blocks && packets_hash % SILENT_INPUTS == 0)
        check_silence(player);
    return packets_hash;
}

/* Exclusive-ors a record into `bytes`, again and again up to their end; an empty one leaves them. */
static void overlay(uint8_t *bytes, size_t size, const uint8_t *record, size_t length)
{
    size_t i;
    for (i = 0; i < size && length > 0; i++)
        bytes[i] ^= record[i % length];
}

/* Takes the record of a model. Returns its bytes, NULL for the built-in tables. */
static uint8_t *take_model(const vc_codec *codec, const uint8_t **data, size_t *length, size_t *model_length)
{
    uint8_t *changes = NULL, *model = NULL;
    size_t changes_length = 0;
    *model_length = 0;
    if (codec == &vc_eva_codec && vc_fuzz_record(data, length, &model, model_length))
        return model;
    if (codec != &vc_mdct_codec)
        return NULL;
    (void)vc_fuzz_record(data, length, &changes, &changes_length);
    if (changes_length > 0) {
        *model_length = vc_mdct_tables_size();
        model = malloc(*model_length);
        memcpy(model, vc_mdct_builtin_tables(), *model_length);
        overlay(model, *model_length, changes, changes_length);
    }
    free(changes);
    return model;
}

static void run(const vc_codec *codec, size_t decoder_size, const uint8_t *data, size_t length)
{
    player player = {codec, {0}, NULL, NULL, NULL, 0, 1};
    uint8_t *configuration = NULL, *model = NULL;
    size_t configuration_length, values;
    uint64_t first;
    player.coding.codec = codec->identifier;
    if (vc_fuzz_record(&data, &length, &configuration, &configuration_length) && configuration_length > 0) {
        player.coding.channels = (uint8_t)(1 + configuration[0] % 16);
        player.coding.configuration = configuration + 1;
        player.coding.configuration_length = configuration_length - 1;
        model = take_model(codec, &data, &length, &player.coding.tables_length);
        player.coding.tables = model;
        if ((model == NULL ? !codec->needs_tables : codec->check_tables(model, player.coding.tables_length) == NULL) &&
            codec->check(&player.coding) == VC_OK && player.coding.packet_samples <= MAX_PACKET_SAMPLES) {
            vc_fuzz_check(player.coding.packet_samples > 0, "packets without samples");
            values = (size_t)player.coding.packet_samples * player.coding.channels;
            player.decoder = malloc(decoder_size);
            player.samples = malloc(values * sizeof *player.samples);
            player.complete = malloc(values * sizeof *player.complete);
            first = play(&player, data, length);
            player.by_blocks = 0;
            vc_fuzz_check(play(&player, data, length) == first, "a decoder that decodes a stream in two ways");
        }
    }
    free(player.complete);
    free(player.samples);
    free(player.decoder);
    free(model);
    free(configuration);
}

#define VC_FUZZ_TARGET(name)                                                                                           \
    void vc_fuzz_##name(const uint8_t *data, size_t length)                                                            \
    {                                                                                                                  \
        run(&vc_##name##_codec, sizeof(struct vc_##name##_decoder), data, length);                                     \
    }
VC_CODECS(VC_FUZZ_TARGET)
