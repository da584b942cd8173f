using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;

namespace Ultragray
{
    /// <summary>The bytes of a scene file while they arrive, up to the end of one of its parts at a time.</summary>
    sealed class Arrival
    {
        const int LengthBytes = 8, MostHeader = 4 << 20; // the latter as libultragray has it
        readonly Stream stream;
        List<int> ends; // of the parts of a compressed file, none of any other; null while its header is not there
        int size; // of what is there

        internal Arrival(Stream stream)
        {
            this.stream = stream;
        }

        internal byte[] Bytes { get; private set; } = new byte[1 << 16];

        /// <summary>Of the bytes, those up to the end of the last part that is there; all, where it is the file's last one, or no other comes.</summary>
        internal int Count { get; private set; }

        internal bool IsWhole { get; private set; }

        /// <summary>Waits until another part is there.</summary>
        internal void Next()
        {
            for (int read = 1; Reached() == Count && read > 0; size += read)
            {
                var bytes = Bytes;
                if (size == bytes.Length) Array.Resize(ref bytes, 2 * size);
                Bytes = bytes;
                read = stream.Read(Bytes, size, Bytes.Length - size);
            }
            int reached = Reached();
            IsWhole = reached == Count || reached == ends.Last();
            Count = reached > Count ? reached : size;
        }

        int Reached()
        {
            ends = ends ?? PartEnds();
            return ends == null ? 0 : ends.LastOrDefault(end => end <= size);
        }

        List<int> PartEnds()
        {
            if (size < LengthBytes) return null;
            ulong length = BitConverter.ToUInt64(Bytes, 0);
            if (length > MostHeader) return new List<int>();
            int begin = LengthBytes + (int)length;
            if (size < begin) return null;
            var header = new JsonReader(Bytes);
            header.Begin(Bytes, LengthBytes, begin);
            try
            {
                var tensors = header.Map<Tensor>((json, it) => json.Object(it)).Where(one => one.Key.StartsWith("part."));
                return tensors.Select(one => begin + (int)one.Value.Offsets[1]).OrderBy(end => end).ToList();
            }
            catch (Exception) // libultragray says what is wrong with it
            {
                return new List<int>();
            }
        }

        sealed class Tensor : IReadable
        {
            internal double[] Offsets;

            public void Read(JsonReader json)
            {
                json.Enter('{');
                while (json.NextMember())
                {
                    if (json.Named("data_offsets")) Offsets = json.Numbers(null);
                    else json.Skip();
                }
            }
        }
    }
}
