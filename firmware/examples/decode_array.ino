/* Decodes the stream of stream.h over and over, and prints its samples: watch them in the Serial Plotter. */
#include <vibrocast.h>

#include "stream.h"

static int64_t memory[STREAM_DECODER_WORDS];
static uint8_t packet[STREAM_PACKET_BYTES]; /* one coded packet */
static int16_t samples[STREAM_SAMPLES];     /* one decoded packet, all channels */
static vc_stream stream;
static size_t taken; /* bytes of stream_bytes */
static int status;

static size_t read_array(void *, uint8_t *data, size_t length)
{
    if (length > sizeof stream_bytes - taken)
        length = sizeof stream_bytes - taken;
    memcpy(data, stream_bytes + taken, length);
    taken += length;
    return length;
}

static void start()
{
    taken = 0;
    stream.read = read_array;
    stream.memory = memory;
    stream.memory_bytes = sizeof memory;
    stream.packet = packet;
    stream.packet_bytes = sizeof packet;
    status = vc_stream_open(&stream);
}

void setup()
{
    Serial.begin(115200);
    start();
}

void loop()
{
    if (status == VC_OK)
        status = vc_stream_next(&stream);
    if (status == VC_END) {
        start();
    } else if (status != VC_OK) {
        Serial.println(vc_status_text(status));
        delay(1000);
    } else {
        while (vc_stream_poll(&stream, samples) < stream.packet_samples) {
        }
        for (uint32_t i = stream.first * stream.channels; i < stream.last * stream.channels; i++)
            Serial.println(samples[i]);
    }
}
