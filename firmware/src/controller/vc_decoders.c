/* The codecs that a controller decodes, behind one interface; see vc_decoders.h. */
#include "vc_decoders.h"

#define ROW(name) &vc_##name##_codec,

static const vc_codec *const codecs[] = {VC_CODECS(ROW)};

int vc_codec_is_in_c(uint8_t identifier)
{
    return vc_codec_find(identifier) != NULL;
}

void vc_codecs_describe(vc_codec_description *descriptions)
{
    unsigned i;
    for (i = 0; i < VC_CODEC_COUNT; i++) {
        descriptions[i].identifier = codecs[i]->identifier;
        descriptions[i].name = vc_text_piece(codecs[i]->name);
    }
}

/* Returns 0 if a codec in C accepts the payload of a model image; else rejects with `code`. */
static int check_tables(uint8_t identifier, const uint8_t *tables, size_t length, enum vc_error_code code,
                        vc_rejection *rejection)
{
    const vc_codec *codec = vc_codec_find(identifier);
    const char *flaw;
    if (codec == NULL || codec->check_tables == NULL)
        return vc_reject_numbers(rejection, code, "codec # takes no model image on this controller", identifier, 0);
    flaw = codec->check_tables(tables, length);
    return flaw == NULL ? 0 : vc_reject(rejection, code, flaw);
}

int vc_tables_check(const void *context, uint8_t codec, const uint8_t *tables, size_t length, vc_rejection *rejection)
{
    const vc_decoder_callbacks *callbacks = context;
    int rejected = VC_NOT_BY_CALLBACKS;
    if (callbacks != NULL)
        rejected = callbacks->check_tables(callbacks->context, codec, tables, length, rejection);
    return rejected != VC_NOT_BY_CALLBACKS ? rejected
                                           : check_tables(codec, tables, length, VC_IMAGE_REJECTED, rejection);
}

int vc_coding_check(vc_coding *coding, const vc_decoder_callbacks *callbacks, vc_rejection *rejection)
{
    const vc_codec *codec = vc_codec_find(coding->codec);
    if (callbacks != NULL && (codec == NULL || coding->tables != NULL)) {
        const int rejected = callbacks->check(callbacks->context, coding, rejection);
        coding->callbacks = callbacks;
        if (rejected != VC_NOT_BY_CALLBACKS)
            return rejected;
    }
    coding->callbacks = NULL;
    switch (vc_codec_check(codec, coding)) {
    case VC_OK:
        return 0;
    case VC_NO_CODEC:
        return vc_reject_numbers(rejection, VC_UNKNOWN_CODEC, "codec # is needed, which this controller does not have",
                                 coding->codec, 0);
    case VC_BAD_TABLES:
        return check_tables(coding->codec, coding->tables, coding->tables_length, VC_UNKNOWN_CODEC, rejection);
    case VC_NEEDS_MODEL:
        vc_reject(rejection, VC_UNKNOWN_CODEC, "the codec ");
        vc_rejection_add(rejection, codec->name);
        return vc_rejection_add(rejection, " needs a model: flash the model image that the stream was coded for");
    case VC_HOST_ONLY:
        return vc_reject(rejection, VC_UNKNOWN_CODEC,
                         "one transform of a whole texture, which only hosts decode: encode in blocks");
    default:
        return vc_reject(rejection, VC_UNKNOWN_CODEC, "the codec configuration is damaged or of another version");
    }
}

void vc_decoder_init(vc_decoder *decoder, const vc_coding *coding)
{
    decoder->callbacks = coding->callbacks;
    decoder->codec = coding->callbacks == NULL ? vc_codec_find(coding->codec) : NULL;
    if (decoder->codec == NULL)
        decoder->callbacks->init(decoder->callbacks->context, coding);
    else
        decoder->codec->init(&decoder->of, coding);
}

int vc_decoder_feed(vc_decoder *decoder, const uint8_t *packet, size_t length)
{
    if (decoder->codec == NULL)
        return decoder->callbacks->feed(decoder->callbacks->context, packet, length);
    return decoder->codec->feed(&decoder->of, packet, length) >= VC_OK;
}

uint32_t vc_decoder_poll(vc_decoder *decoder, int16_t *samples)
{
    if (decoder->codec == NULL)
        return decoder->callbacks->poll(decoder->callbacks->context, samples);
    return decoder->codec->poll(&decoder->of, samples);
}
