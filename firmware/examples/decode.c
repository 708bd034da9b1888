/* Decodes a .vct file into 16-bit samples, the channels interleaved: decode FILE.vct FILE.pcm [MODEL.vcmi] */
#include <stdio.h>

#include "vibrocast/decoder.h"

static int64_t memory[VC_DECODER_WORDS];
static uint8_t packet[65535];    /* one coded packet */
static int16_t samples[1 << 20]; /* one decoded packet, all channels */
static uint8_t model[1 << 20];

static size_t read_file(void *file, uint8_t *data, size_t length)
{
    return fread(data, 1, length, file);
}

int main(int count, char **arguments)
{
    FILE *coded = count > 2 ? fopen(arguments[1], "rb") : NULL, *decoded = coded ? fopen(arguments[2], "wb") : NULL;
    FILE *image = count > 3 ? fopen(arguments[3], "rb") : NULL;
    vc_stream stream = {.read = read_file,
                        .context = coded,
                        .memory = memory,
                        .memory_bytes = sizeof memory,
                        .packet = packet,
                        .packet_bytes = sizeof packet,
                        .model = image ? model : NULL,
                        .model_bytes = image ? fread(model, 1, sizeof model, image) : 0};
    int status;
    if (!decoded || (count > 3 && !image)) {
        fputs("give a .vct file, a new file and, if the stream needs one, a model image\n", stderr);
        return 2;
    }
    status = vc_stream_open(&stream);
    if (status == VC_OK && (size_t)stream.packet_samples * stream.channels > sizeof samples / sizeof *samples)
        status = VC_TOO_SMALL;
    while (status == VC_OK && (status = vc_stream_next(&stream)) == VC_OK) {
        const int16_t *first = samples + stream.first * stream.channels;
        while (vc_stream_poll(&stream, samples) < stream.packet_samples) {
        }
        fwrite(first, sizeof *first, (size_t)(stream.last - stream.first) * stream.channels, decoded);
    }
    if (fclose(decoded) != 0 || status != VC_END)
        fprintf(stderr, "%s\n", status == VC_END ? "the samples cannot be written" : vc_status_text(status));
    return status == VC_END ? 0 : 1;
}
