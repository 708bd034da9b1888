/* The codecs of this build, found by their identifiers; see vc_codec.h. */
#include "vc_codec.h"

#include "vibrocast/status.h"

const vc_codec *vc_codec_find(uint8_t identifier)
{
#define ROW(name) &vc_##name##_codec,
    static const vc_codec *const codecs[] = {VC_CODECS(ROW)};
    size_t i;
    for (i = 0; i < sizeof codecs / sizeof *codecs; i++)
        if (codecs[i]->identifier == identifier)
            return codecs[i];
    return NULL;
}

int vc_codec_check(const vc_codec *codec, vc_coding *coding)
{
    if (codec == NULL)
        return VC_NO_CODEC;
    if (coding->tables == NULL && codec->needs_tables)
        return VC_NEEDS_MODEL;
    if (coding->tables != NULL &&
        (codec->check_tables == NULL || codec->check_tables(coding->tables, coding->tables_length) != NULL))
        return VC_BAD_TABLES;
    return codec->check(coding);
}
